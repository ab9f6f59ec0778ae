"""A stranger's step, seen at work: called, recorded as a program, and compared with it.

What is bounded is the program. That the step does what the program says is tested wherever a difference would show:
before the propagator works, and on the tube that it gives.
"""

from __future__ import annotations

import inspect
import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sagemp_cli.errors import NonFiniteError, SagempError, UsageError
from sagemp_cli.reachability.program.comparing import (
    MOST_POINTS,
    climbed,
    compare,
    corners_and_centres,
    near_kinks,
)
from sagemp_cli.reachability.program.loops import RecordedLoop
from sagemp_cli.reachability.program.probing import GlobalRandomness, Step, probe, reproduced, steady
from sagemp_cli.reachability.propagator import Loop
from sagemp_cli.sets import Box, Tube

ROLLOUTS = 12
"""Rollouts that are simulated to compare the step with its recorded program and with the tube."""


@dataclass(frozen=True, eq=False)
class Observed:
    """A step with its program.

    Attributes:
        loop: what a propagator bounds.
        start, disturbance: where the step is used, ``(n,)`` and ``(d,)``.
        states, disturbances: simulated rollouts, ``(R, K+1, n)`` and ``(R, K, d)``; NaN after an overflow.
    """

    loop: RecordedLoop
    start: Box
    disturbance: Box
    states: Tensor
    disturbances: Tensor
    called: Step
    drawn: GlobalRandomness

    def compare(self, cells: Box, tube: Tube) -> None:
        """Refuse a step that is found to differ from its program, or to depend on anything else than ``x`` and ``w``.

        Args:
            cells: of the start box, ``(C, n)``.
            tube: of all of them, ``(K+1, n)``.

        Raises:
            UsageError: it does.
            SagempError: a simulated rollout leaves the tube, which is a bug of ours.
        """
        _compare_at_the_start(self.called, self.loop, cells, self.start, self.disturbance)
        _compare_on_the_tube(self.called, self.loop, tube, self.disturbance)
        steady(self.called, self.states[0, 0], self.disturbances[0, 0])
        self.drawn.refuse()
        _check_inside(tube, self.states)


def observed(
    step: Callable[..., Any] | Loop,
    start: Box,
    disturbance: Box | None,
    horizon: int | None,
    *,
    batched: bool | None = None,
) -> Observed:
    """A step recorded, after it was called on some states; arguments and errors as of
    :func:`~sagemp_cli.reachability.any_loop.reach`.
    """
    check_box("start", start)
    function, steps, varying = _function(step, start.dim, horizon)
    if disturbance is None:
        function, disturbance = _undisturbed(function, step), Box.around([0.0], [0.0])
    check_box("disturbance", disturbance)
    drawn = GlobalRandomness()
    called = probe(function, start, disturbance, batched=batched)
    states, disturbances = _simulated(called, start, disturbance, steps)
    loop = _recorded(called, states, disturbances, steps, varying)
    return Observed(loop, start, disturbance, states, disturbances, called, drawn)


def _undisturbed(function: Callable[[int, Any, Any], Any], step: Any) -> Callable[[int, Any, Any], Any]:
    """The function without disturbance, if its step does not take one."""
    own = step if callable(step) else step.step
    wanted = _required(own)
    if wanted is None or len(wanted) > 1 + (not callable(step)):
        return function
    return (lambda k, x, w: step(x)) if callable(step) else (lambda k, x, w: step.step(k, x))


def _required(function: Any) -> list[str] | None:
    """Names of the arguments that a function must be given in order; None if that is not known."""
    try:
        wanted = list(inspect.signature(getattr(function, "forward", function)).parameters.values())
    except (TypeError, ValueError):
        return None
    if any(p.kind is p.VAR_POSITIONAL for p in wanted):
        return None
    return [p.name for p in wanted if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD) and p.default is p.empty]


def check_box(name: str, box: Any) -> None:
    """Refuse what is no box ``(n,)`` of finite sides."""
    if not isinstance(box, Box):
        raise UsageError(
            f"{name} must be a Box, for instance Box.around([0.0, 0.0], [0.1, 0.1]), found {type(box).__name__}"
        )
    if box.lower.dim() != 1 or box.dim == 0:
        raise UsageError(f"{name} must be one box of shape (n,), found shape {tuple(box.lower.shape)}")
    if not bool(torch.isfinite(box.lower).all() & torch.isfinite(box.upper).all()):
        raise NonFiniteError(f"{name} box must be finite")


def _function(step: Any, n: int, horizon: Any) -> tuple[Callable[[int, Any, Any], Any], int, bool]:
    """``(k, x, w) -> x_next``, the number of steps, and whether steps differ."""
    loop: Any = step  # a checker of types takes what has been called callable for a function
    is_loop = not callable(step) and callable(getattr(step, "step", None))
    if not is_loop and not callable(step):
        raise UsageError(
            f"step must be a function step(x, w) or a loop with step(k, x, w), found {type(step).__name__}"
        )
    if is_loop and horizon is None:
        horizon = loop.horizon
    try:
        steps = operator.index(horizon)
    except TypeError:
        steps = 0
    if steps < 1 or isinstance(horizon, bool):
        raise UsageError(f"horizon must be a positive integer, found {horizon!r}")
    if not is_loop and len(_required(step) or ()) == 3:
        return step, steps, True
    if not is_loop:
        return lambda k, x, w: step(x, w), steps, False
    if loop.state_dim != n:
        raise UsageError(f"the loop has {loop.state_dim} states, the start box has {n}")
    if steps > loop.horizon:
        raise UsageError(f"horizon {steps} is longer than the loop's, {loop.horizon}")
    return loop.step, steps, True


def _simulated(step: Step, start: Box, disturbance: Box, steps: int) -> tuple[Tensor, Tensor]:
    """Rollouts ``(R, K+1, n)`` and their disturbances ``(R, K, d)``; NaN after an overflow."""
    generator = torch.Generator().manual_seed(1)
    x = start.sample(ROLLOUTS, generator)
    corner = torch.rand(x.shape, generator=generator) < 0.5
    x[::2] = torch.where(corner, start.lower, start.upper)[::2]
    w = disturbance.sample(ROLLOUTS * steps, generator).unflatten(0, (ROLLOUTS, steps))
    extreme = torch.where(torch.rand(w.shape, generator=generator) < 0.5, disturbance.lower, disturbance.upper)
    w[::2] = extreme[::2]
    states = torch.full((ROLLOUTS, steps + 1, start.dim), torch.nan, dtype=torch.float64)
    states[:, 0] = x
    with torch.no_grad():
        for k in range(steps):
            alive = torch.isfinite(states[:, k]).all(-1)
            if not bool(alive.any()):
                break
            after = step.all(k, states[alive, k], w[alive, k])
            states[alive, k + 1] = torch.where(torch.isfinite(after).all(-1, keepdim=True), after, torch.nan)
    return states, w


def _recorded(step: Step, states: Tensor, disturbances: Tensor, steps: int, varying: bool) -> RecordedLoop:
    """The loop as programs that do, on all simulated states, what the step does."""
    before = step.all(0, states[:, 0], disturbances[:, 0])
    programs = tuple(step.record(k, states[0, 0], disturbances[0, k]) for k in range(steps if varying else 1))
    if all(programs[0].same_as(other) for other in programs[1:]):
        programs, varying = programs[:1], False
    reproduced(step, states[:, 0], disturbances[:, 0], before)
    # One comparison for all steps that one program serves.
    at = [slice(k, k + 1) for k in range(steps)] if varying else [slice(0, steps)]
    for k, (program, part) in enumerate(zip(programs, at, strict=True)):
        after = states[:, 1:][:, part].flatten(0, 1)
        compare(step, k, program, states[:, part].flatten(0, 1), disturbances[:, part].flatten(0, 1), after)
    return RecordedLoop(programs, torch.zeros(steps, 0, dtype=torch.float64), steps)


def _compare_at_the_start(step: Step, loop: RecordedLoop, cells: Box, start: Box, disturbance: Box) -> None:
    """Compare step and program where they may differ: cells' corners and centres, thresholds, along the gradient."""
    program = loop.programs[0]
    compare(step, 0, program, *corners_and_centres(cells, disturbance, most=MOST_POINTS[step.rowwise]))
    compare(step, 0, program, *near_kinks(program, start, disturbance))
    points = climbed(step, program, start, disturbance)
    if points is not None:
        compare(step, 0, program, *points)


def _compare_on_the_tube(step: Step, loop: RecordedLoop, tube: Tube, disturbance: Box) -> None:
    """Compare step and program at the centres and at corners of the tube's boxes."""
    most = MOST_POINTS[step.rowwise]
    bounded = torch.isfinite(tube.lower).all(-1) & torch.isfinite(tube.upper).all(-1)
    if len(loop.programs) == 1:
        boxes = Box(tube.lower[:-1][bounded[:-1]], tube.upper[:-1][bounded[:-1]])
        compare(step, 0, loop.programs[0], *corners_and_centres(boxes, disturbance, most=most))
        return
    for k, program in enumerate(loop.programs):
        if bool(bounded[k]):
            box = Box(tube.lower[k : k + 1], tube.upper[k : k + 1])
            compare(step, k, program, *corners_and_centres(box, disturbance, most=max(2, most // loop.horizon)))


def _check_inside(tube: Tube, states: Tensor) -> None:
    """Refuse to return a tube that a simulated rollout leaves; rounding of the simulation is forgiven."""
    slack = 1e-9 * (1.0 + states.abs())
    out = (states < tube.lower - slack) | (states > tube.upper + slack)
    if bool(out.any()):
        _, k, i = torch.nonzero(out)[0].tolist()
        raise SagempError(
            f"a simulated rollout leaves the tube at step {k} in state {i}; no tube is returned, please report this"
        )
