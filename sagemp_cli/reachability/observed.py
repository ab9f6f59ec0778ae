"""A stranger's step, seen at work: called, recorded as a program, and compared with it.

What is bounded is the program. That the step does what the program says is tested wherever a difference would show:
before the propagator works, and on the tube that it gives.
"""

from __future__ import annotations

import inspect
import operator
from collections.abc import Callable, Sequence
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
from sagemp_cli.reachability.program.probing import (
    TOLERANCE,
    GlobalRandomness,
    Step,
    probe,
    reproduced,
    steady,
)
from sagemp_cli.reachability.propagator import Loop
from sagemp_cli.sets import Box, Tube

Points = tuple[Tensor, Tensor]
"""States ``(B, n)`` and disturbances ``(B, d)``."""

ROLLOUTS = 12
"""Rollouts that are simulated to compare the step with its recorded program and with the tube."""


@dataclass(frozen=True, eq=False)
class Observed:
    """A step with its program.

    Attributes:
        loop: what a propagator bounds.
        start, disturbance: where the step is used, ``(n,)`` and ``(d,)``.
        states, disturbances: rollouts of the programs, ``(R, K+1, n)`` and ``(R, K, d)``; NaN after an overflow.
        numbered: whether the step is told its number.
    """

    loop: RecordedLoop
    start: Box
    disturbance: Box
    states: Tensor
    disturbances: Tensor
    called: Step
    numbered: bool
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
        _compare(self.called, self.loop, self._on_the_tube(tube), numbered=self.numbered)
        steady(self.called, self.states[0, 0], self.disturbances[0, 0])
        self.drawn.refuse()
        _check_inside(tube, self.states)

    def _on_the_tube(self, tube: Tube) -> list[Points]:
        """The centres and corners of the tube's boxes, of some boxes where there are many."""
        most, rows = MOST_POINTS[self.called.rowwise], self.loop.horizon
        bounded = torch.isfinite(tube.lower).all(-1) & torch.isfinite(tube.upper).all(-1)
        boxes = [Box(tube.lower[k : k + 1], tube.upper[k : k + 1]) for k in range(rows)]
        if not self.numbered:
            boxes, bounded = [Box(tube.lower[:-1][bounded[:-1]], tube.upper[:-1][bounded[:-1]])], [True]
        at_each = max(2, most // len(boxes))
        return [
            corners_and_centres(
                box if bounded[k] else Box(box.lower[:0], box.upper[:0]), self.disturbance, most=at_each
            )
            for k, box in enumerate(boxes)
        ]


def observed(
    step: Callable[..., Any] | Loop,
    start: Box,
    disturbance: Box | None,
    horizon: int | None,
    *,
    batched: bool | None = None,
    numbers: bool = False,
) -> Observed:
    """A step recorded, after it was called on some states; arguments and errors as of
    :func:`~sagemp_cli.reachability.any_loop.reach`.

    Args:
        numbers: whether steps that differ in what they add may be one program, with numbers of each step's own.
    """
    check_box("start", start)
    function, steps, numbered = _function(step, start.dim, horizon)
    if disturbance is None:
        function, disturbance = _undisturbed(function, step), Box.around([0.0], [0.0])
    check_box("disturbance", disturbance)
    drawn = GlobalRandomness()
    called = probe(function, start, disturbance, batched=batched)
    x, w = _drawn(start, disturbance, steps)
    before = called.all(0, x, w[:, 0])
    loop = called.recorded(x[0], w[0], numbered=numbered, numbers=numbers)
    reproduced(called, x, w[:, 0], before)
    states = _rollouts(loop, x, w)
    points = [_finite(states[:, k], w[:, k]) for k in range(steps)]
    _compare(called, loop, points, numbered=numbered)
    return Observed(loop, start, disturbance, states, w, called, numbered, drawn)


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
    """``(k, x, w) -> x_next``, the number of steps, and whether it is told which."""
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


def _drawn(start: Box, disturbance: Box, steps: int) -> Points:
    """Starts ``(R, n)`` and disturbances ``(R, K, d)`` of rollouts: inside, and of every other one at corners."""
    generator = torch.Generator().manual_seed(1)
    x = start.sample(ROLLOUTS, generator)
    corner = torch.rand(x.shape, generator=generator) < 0.5
    x[::2] = torch.where(corner, start.lower, start.upper)[::2]
    w = disturbance.sample(ROLLOUTS * steps, generator).unflatten(0, (ROLLOUTS, steps))
    extreme = torch.where(torch.rand(w.shape, generator=generator) < 0.5, disturbance.lower, disturbance.upper)
    w[::2] = extreme[::2]
    return x, w


def _rollouts(loop: RecordedLoop, x: Tensor, w: Tensor) -> Tensor:
    """The states ``(R, K+1, n)`` that the programs go through; NaN after an overflow.

    Those of the step are the same up to rounding, or it is found out where it first does something else.
    """
    states = [x]
    with torch.no_grad():
        for k in range(loop.horizon):
            after = loop.step(k, states[-1], w[:, k])
            known = (torch.isfinite(after) & torch.isfinite(states[-1])).all(-1, keepdim=True)
            states.append(torch.where(known, after, torch.nan))
    return torch.stack(states, dim=1)


def _finite(x: Tensor, w: Tensor) -> Points:
    known = torch.isfinite(x).all(-1)
    return x[known], w[known]


@torch.no_grad()
def _compare(step: Step, loop: RecordedLoop, points: Sequence[Points], *, numbered: bool) -> None:
    """Compare step and program at points: of each step, if it is told which it is, or all of them together."""
    most = MOST_POINTS[step.rowwise]
    programs = loop.programs
    if not numbered:
        x, w = (torch.cat(some) for some in zip(*points, strict=True))
        for some in zip(x.split(most), w.split(most), strict=True):
            compare(step, 0, programs[0], *some)
        return
    if len(programs) > 1:
        for k, (program, some) in enumerate(zip(programs, points, strict=True)):
            compare(step, k, program, *some)
        return
    after = [step.all(k, x, w) if len(x) else x for k, (x, w) in enumerate(points)]
    number = torch.arange(len(points)).repeat_interleave(torch.tensor([len(x) for x, _ in points]))
    together = [*(torch.cat(some) for some in zip(*points, strict=True)), torch.cat(after), number]
    for x, w, y, k in zip(*(some.split(most) for some in together), strict=True):
        compare(step, k, loop.program(0), x, w, y, loop.numbers[k])


def _compare_at_the_start(step: Step, loop: RecordedLoop, cells: Box, start: Box, disturbance: Box) -> None:
    """Compare step and program where they may differ: cells' corners and centres, thresholds, along the gradient."""
    program, numbers = loop.programs[0], loop.numbers[0]
    found = [
        corners_and_centres(cells, disturbance, most=MOST_POINTS[step.rowwise]),
        near_kinks(program, numbers, start, disturbance),
        climbed(step, program, numbers, start, disturbance),
    ]
    for points in found:
        compare(step, 0, program, *points, numbers=numbers)


def _check_inside(tube: Tube, states: Tensor) -> None:
    """Refuse to return a tube that a simulated rollout leaves.

    A rollout in floats has roundings of its own, which the loop carries on and no tube encloses. What two evaluations
    of the same formulas may differ by is forgiven, as wherever the two are compared without an account of rounding.
    """
    slack = TOLERANCE * (1.0 + states.abs())
    out = (states < tube.lower - slack) | (states > tube.upper + slack)
    if bool(out.any()):
        _, k, i = torch.nonzero(out)[0].tolist()
        raise SagempError(
            f"a simulated rollout leaves the tube at step {k} in state {i}; no tube is returned, please report this"
        )
