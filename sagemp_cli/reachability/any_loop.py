"""The tube of any closed loop that is written in torch: the entry point for other people's robots and controllers."""

from __future__ import annotations

import importlib
import inspect
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from sagemp_cli.errors import NonFiniteError, SagempError, UsageError, did_you_mean
from sagemp_cli.reachability.program.comparing import (
    MOST_POINTS,
    climbed,
    compare,
    corners_and_centres,
    near_kinks,
)
from sagemp_cli.reachability.program.loops import RecordedLoop
from sagemp_cli.reachability.program.probing import GlobalRandomness, Step, probe, reproduced, steady
from sagemp_cli.reachability.propagator import Loop, Propagator
from sagemp_cli.sets import Box, Tube
from sagemp_cli.sets.partition import parse_partitions, partition, uncertain_dimensions

PROPAGATORS = {
    "affine": ("affine.affine", "Affine"),
    "auto_lirpa": ("lirpa.auto_lirpa", "AutoLirpa"),
    "best": ("crown.best", "Best"),
    "crown": ("crown.crown", "Crown"),
    "interval": ("interval.interval", "Interval"),
}
"""Name to module of this package and class."""

AUTO_CELLS = 64
"""Cells at most with ``partitions="auto"``."""

_GAIN = 0.02
"""What doubling the cells must narrow the tube by."""

ROLLOUTS = 12
"""Rollouts that are simulated to compare the step with its recorded program and with the tube."""


def reach(
    step: Callable[..., Any] | Loop,
    start: Box,
    disturbance: Box | None = None,
    horizon: int | None = None,
    *,
    propagator: str | Propagator = "affine",
    partitions: int | str | Sequence[int] = 1,
    batched: bool | None = None,
    cells_at_once: int = 64,
    per_cell: bool = False,
) -> Tube:
    """Tube ``(K+1, n)`` around all rollouts ``x_{k+1} = step(x_k, w_k)`` with ``x_0`` and ``w_k`` in their boxes.

    ``step`` is any torch code, a neural network with float32 weights included. It is called on a few tensors, to see
    what shapes it wants and that it is a function of its arguments, and recorded once on values that refuse what cannot
    be bounded. The propagator gets the recorded program. Enclosed are the rollouts in real arithmetic, the constants
    that meet ``x`` or ``w`` taken as the exact numbers they are; what the step computes from constants alone is taken
    as torch computes it. A simulated rollout differs by its own rounding (most in float32), which is not enclosed.

    Not proved, but tested: that the step always does what it did when it was recorded (no hidden state, no randomness).
    A step whose calls differ (a few dozen at random states, then 50 to 200 at one), that draws from the random
    generators shared by all, or that differs from the recorded program by more than rounding on simulated rollouts, at
    corners and centres of cells and of the tube's boxes, or near the program's thresholds, is refused. A change that
    shows only after more calls, or depends on a clock, is not noticed.

    Args:
        step: ``step(x, w)`` on a state ``(n,)`` and a disturbance ``(d,)`` or on batches ``(B, n)``, ``(B, d)``; it
            returns the next state in the shape of ``x``. Or a :class:`~sagemp_cli.reachability.propagator.Loop`, whose
            ``step(k, x, w)`` may depend on the step number.
        start: box ``(n,)`` of starts; sides of width zero are allowed.
        disturbance: box ``(d,)`` of disturbances, anew at every step; d need not be n. None if there are none: the step
            may then be ``step(x)``, or gets a single 0 as ``w``.
        horizon: number of steps K; of a loop at most its own, and its own by default.
        propagator: one of :data:`PROPAGATORS`, or a propagator itself.
        partitions: cells of the start box in all, or counts per uncertain dimension (``"2x2"``, ``[2, 2]``), or
            ``"auto"``: from one cell on, the count is doubled in the dimension where that narrows the tube most, while
            it narrows it by 2 % at least, up to :data:`AUTO_CELLS` cells.
        batched: whether the step takes batches; None finds out.
        cells_at_once: most cells in one call of the propagator, which bounds the memory.
        per_cell: whether to give one tube per cell, ``(C, K+1, n)``; row 0 of each is its cell.

    Returns:
        The smallest boxes around the tubes of all cells; row 0 is the start box. Rows are infinite after an overflow.

    Raises:
        UnsupportedOperationError: an operation that cannot be bounded; the message names it and the line.
        NonFiniteError: a constant or a result that is NaN or infinite.
        UsageError: everything else that is wrong with the arguments or the step.
    """
    _check_box("start", start)
    function, steps, varying = _function(step, start.dim, horizon)
    if disturbance is None:
        function, disturbance = _undisturbed(function, step), Box.around([0.0], [0.0])
    _check_box("disturbance", disturbance)
    chosen = _propagator(propagator)
    if isinstance(cells_at_once, bool) or not isinstance(cells_at_once, int) or cells_at_once < 1:
        raise UsageError(f"cells_at_once must be a positive integer, found {cells_at_once!r}")
    counts = _counts(partitions, start)
    drawn = GlobalRandomness()
    called = probe(function, start, disturbance, batched=batched)
    states, disturbances = _simulated(called, start, disturbance, steps)
    loop = _recorded(called, states, disturbances, steps, varying)

    def tubes_of(cells: Box) -> Tube:
        chunks = zip(cells.lower.split(cells_at_once), cells.upper.split(cells_at_once), strict=True)
        with torch.no_grad():
            tubes = [chosen.propagate(loop, Box(low, high), disturbance) for low, high in chunks]
        return Tube(torch.cat([t.lower for t in tubes]), torch.cat([t.upper for t in tubes]))

    tubes = _adapted(tubes_of, start) if counts is None else tubes_of(_cells(start, counts))
    cells, tube = Box(tubes.lower[:, 0], tubes.upper[:, 0]), tubes.hull()
    _compare_at_the_start(called, loop, cells, start, disturbance)
    _compare_on_the_tube(called, loop, tube, disturbance)
    steady(called, states[0, 0], disturbances[0, 0])
    drawn.refuse()
    _check_inside(tube, states)
    return tubes if per_cell else tube


def _counts(partitions: Any, start: Box) -> list[int] | None:
    """Cells per uncertain dimension; None if they are to be found."""
    uncertain = len(uncertain_dimensions(start))
    counts = parse_partitions(partitions, max(uncertain, 1), auto=True)
    if uncertain == 0 and counts not in ([1], None):
        raise UsageError(f"partitions must be 1 for a start box that is a point, found {partitions!r}")
    return [] if uncertain == 0 else counts


def _cells(start: Box, counts: Sequence[int]) -> Box:
    return partition(start, counts) if counts else Box(start.lower[None], start.upper[None])


def _adapted(tubes_of: Callable[[Box], Tube], start: Box) -> Tube:
    """Tubes of as many cells as pay; see :func:`reach`."""
    counts = [1] * len(uncertain_dimensions(start))
    tubes = tubes_of(_cells(start, counts))
    while 2 * math.prod(counts) <= AUTO_CELLS:
        trials = [[c * (1 + (i == d)) for i, c in enumerate(counts)] for d in range(len(counts))]
        found = [tubes_of(_cells(start, trial)) for trial in trials]
        widths = [_log_width(t.hull()) for t in found]
        best = min(range(len(found)), key=widths.__getitem__)
        if not widths[best] < _log_width(tubes.hull()) + math.log(1 - _GAIN):
            break
        counts, tubes = trials[best], found[best]
    return tubes


def _log_width(tube: Tube) -> float:
    """Mean over steps after the start and states, of the width's logarithm; huge where it is infinite."""
    width = torch.nan_to_num(tube.width[1:], nan=1e300, posinf=1e300)
    return float(width.clamp(1e-300, 1e300).log().mean())


def _undisturbed(function: Callable[[int, Any, Any], Any], step: Any) -> Callable[[int, Any, Any], Any]:
    """The function without disturbance, if its step does not take one."""
    own = getattr(step, "forward", step) if callable(step) else step.step
    try:
        wanted = list(inspect.signature(own).parameters.values())
    except (TypeError, ValueError):
        return function
    positional = [p for p in wanted if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    required = [p for p in positional if p.default is p.empty]
    several = any(p.kind is p.VAR_POSITIONAL for p in wanted)
    if several or len(required) > 1 + (not callable(step)):
        return function
    return (lambda k, x, w: step(x)) if callable(step) else (lambda k, x, w: step.step(k, x))


def _check_box(name: str, box: Any) -> None:
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
    is_loop = not callable(step) and callable(getattr(step, "step", None))
    if not is_loop and not callable(step):
        raise UsageError(
            f"step must be a function step(x, w) or a loop with step(k, x, w), found {type(step).__name__}"
        )
    if is_loop and horizon is None:
        horizon = step.horizon
    try:
        steps = operator.index(horizon)
    except TypeError:
        steps = 0
    if steps < 1 or isinstance(horizon, bool):
        raise UsageError(f"horizon must be a positive integer, found {horizon!r}")
    if not is_loop:
        return lambda k, x, w: step(x, w), steps, False
    if step.state_dim != n:
        raise UsageError(f"the loop has {step.state_dim} states, the start box has {n}")
    if steps > step.horizon:
        raise UsageError(f"horizon {steps} is longer than the loop's, {step.horizon}")
    return step.step, steps, True


def _propagator(propagator: str | Propagator) -> Propagator:
    if not isinstance(propagator, str):
        if not callable(getattr(propagator, "propagate", None)):
            raise UsageError(f"propagator must be a name or have a method propagate, found {type(propagator).__name__}")
        return propagator
    if propagator not in PROPAGATORS:
        raise UsageError(
            f"propagator must be one of {', '.join(PROPAGATORS)}, found '{propagator}'"
            f"{did_you_mean(propagator, PROPAGATORS)}"
        )
    module, name = PROPAGATORS[propagator]
    return getattr(importlib.import_module(f"sagemp_cli.reachability.{module}"), name)()


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
