"""The tube of any closed loop that is written in torch: the entry point for other people's robots and controllers."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch

from sagemp_cli.errors import TubeWarning, UsageError, did_you_mean
from sagemp_cli.plugins.registry import names, resolve
from sagemp_cli.reachability.foreseeing import reach_foreseeing
from sagemp_cli.reachability.halves import Halves
from sagemp_cli.reachability.narrowing import narrowing_cells
from sagemp_cli.reachability.observed import check_box, observed
from sagemp_cli.reachability.propagator import Loop, Propagator, Reach
from sagemp_cli.sets import Box, Tube
from sagemp_cli.sets.partition import parse_partitions, partition, uncertain_dimensions


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
            returns the next state in the shape of ``x``. Or ``step(k, x, w)``, which may depend on the step number; or
            a :class:`~sagemp_cli.reachability.propagator.Loop`, which has such a method.
        start: box ``(n,)`` of starts; sides of width zero are allowed.
        disturbance: box ``(d,)`` of disturbances, anew at every step; d need not be n. None if there are none: the step
            may then be ``step(x)``, or gets a single 0 as ``w``.
        horizon: number of steps K; of a loop at most its own, and its own by default.
        propagator: a name that configs know (``affine``, ``best``, ...), or a propagator itself.
        partitions: cells of the start box in all, or counts per uncertain dimension (``"2x2"``, ``[2, 2]``), or
            ``"auto"``: from one cell on, those are halved that the tube's hull hangs on, each in the state where that
            narrows it most, while it pays, up to 64 cells; see :func:`.narrowing.narrowing_cells`.
        batched: whether the step takes batches; None finds out.
        cells_at_once: most cells in one call of the propagator, which bounds the memory.
        per_cell: whether to give one tube per cell, ``(C, K+1, n)``; row 0 of each is its cell.

    Returns:
        The smallest boxes around the tubes of all cells; row 0 is the start box. Rows are infinite after an overflow.

    Warns:
        TubeWarning: what the propagator notes of the tube, for instance that it is wide because symbols were boxed.

    Raises:
        UnsupportedOperationError: an operation that cannot be bounded; the message names it and the line.
        NonFiniteError: a constant or a result that is NaN or infinite.
        UsageError: everything else that is wrong with the arguments or the step.
    """
    check_box("start", start)
    chosen, counts = propagator_of(propagator), counts_of(partitions, start)
    if isinstance(cells_at_once, bool) or not isinstance(cells_at_once, int) or cells_at_once < 1:
        raise UsageError(f"cells_at_once must be a positive integer, found {cells_at_once!r}")
    seen = observed(step, start, disturbance, horizon, batched=batched, numbers=True)
    loop, disturbance = seen.loop, seen.disturbance

    notes: dict[str, None] = {}

    def bounded(cells: Box, propagate: Callable[..., Reach]) -> list[Reach]:
        chunks = zip(cells.lower.split(cells_at_once), cells.upper.split(cells_at_once), strict=True)
        with torch.no_grad():
            found = [propagate(chosen, loop, Box(low, high), disturbance) for low, high in chunks]
        notes.update(dict.fromkeys(note for one in found for note in one.notes))
        return found

    if counts is None:
        tubes = narrowing_cells(lambda cells: _with_halves(bounded(cells, reach_foreseeing)), start)
    else:
        tubes = _together(bounded(cells_of(start, counts), type(chosen).reach))
    tube = tubes.hull()
    seen.compare(Box(tubes.lower[:, 0], tubes.upper[:, 0]), tube)
    for note in notes:
        warnings.warn(note, TubeWarning, stacklevel=2)
    return tubes if per_cell else tube


def counts_of(partitions: Any, start: Box) -> list[int] | None:
    """Cells per uncertain dimension; None if they are to be found."""
    uncertain = len(uncertain_dimensions(start))
    counts = parse_partitions(partitions, max(uncertain, 1), auto=True)
    if uncertain == 0 and counts not in ([1], None):
        raise UsageError(f"partitions must be 1 for a start box that is a point, found {partitions!r}")
    return [] if uncertain == 0 else counts


def cells_of(start: Box, counts: Sequence[int]) -> Box:
    """The cells ``(C, n)`` of a start box; itself if it is a point."""
    return partition(start, counts) if counts else Box(start.lower[None], start.upper[None])


def _together(found: Sequence[Reach]) -> Tube:
    """The tubes of all cells."""
    return Tube(torch.cat([one.tube.lower for one in found]), torch.cat([one.tube.upper for one in found]))


def _with_halves(found: Sequence[Reach]) -> tuple[Tube, Halves]:
    """The same, and what halving the cells would do."""
    halves = Halves.join([one.halves for one in found])
    assert halves is not None
    return _together(found), halves


def propagator_of(propagator: str | Propagator) -> Propagator:
    """A propagator, by name or itself."""
    if isinstance(propagator, str):
        known = names("propagator")
        if propagator not in known:
            raise UsageError(
                f"propagator must be one of {', '.join(known)}, found '{propagator}'{did_you_mean(propagator, known)}"
            )
        propagator = resolve("propagator", propagator, "propagator")()
    if not isinstance(propagator, Propagator):
        raise UsageError(f"propagator must be a name or a Propagator, found {type(propagator).__name__}")
    return propagator
