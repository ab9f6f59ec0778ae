"""Reach sets of a sampled loop in continuous time.

The remainder of every part of every period is guessed, the loop is propagated with it as one more disturbance, and what
it has to contain is then computed on the sets that came out, for many periods at once. Where the guess holds all of it,
induction over the parts makes the sets reach sets; else what was computed, widened, is the next guess.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.reachability.affine.affine import Affine, AffineRun
from sagemp_cli.reachability.affine.halving import Halving
from sagemp_cli.reachability.continuous.enclosure import enclosure
from sagemp_cli.reachability.continuous.expansion import Expansion, expansion
from sagemp_cli.reachability.continuous.sampled import SampledLoop
from sagemp_cli.reachability.flow import Division, Flow
from sagemp_cli.reachability.interval.form import IntervalForm
from sagemp_cli.reachability.program.loops import RecordedLoop
from sagemp_cli.sets import Box, Tube
from sagemp_cli.sets.rounding import TINY
from sagemp_cli.sets.zonotope import Zonotope

_ATTEMPTS = 8
"""Guesses of the remainders of a run of periods."""
_FIRST, _LONGEST = 4, 32
"""Periods that are propagated at a time, at first and at most."""
_MARGIN = 0.05
"""Share of its width that a guess is wider than what it was made from."""
_AHEAD = 0.3
"""The same of a guess for periods that were not looked at yet."""
_SEEN = 8
"""Periods that a guess for the next ones looks back on."""


@dataclass(frozen=True)
class FlowRun:
    """What was found.

    Attributes:
        run: of the step programs; its watched values are controls and then states within the period.
        flow: between the instants.
        failed: the first period of each cell in which no enclosure was found, K if there is none, ``(C,)``.
    """

    run: AffineRun
    flow: Flow
    failed: Tensor


@dataclass(frozen=True)
class _Block:
    """Some periods in a row.

    Attributes:
        run: with guessed remainders.
        flow: with these.
        needed: what they have to contain, ``(2, C, K, S, n)``.
    """

    run: AffineRun
    flow: Flow
    needed: Tensor

    @property
    def holds(self) -> Tensor:
        """Whether they do, ``(C, K)``."""
        low, high = self.needed
        inside = (self.flow.remainder_lower <= low) & (high <= self.flow.remainder_upper)
        return inside.flatten(2).all(-1)

    @property
    def settled(self) -> Tensor:
        """Whether another guess is of no use, ``(C, K)``."""
        tube = self.run.tube
        bounded = torch.isfinite(tube.lower[:, :-1]).all(-1) & torch.isfinite(tube.upper[:, :-1]).all(-1)
        found = torch.isfinite(self.needed).all(0).flatten(2).all(-1)  # larger remainders only make larger sets
        return self.holds | ~bounded | ~found

    def widened(self) -> Tensor:
        """The next guess, ``(2, K, C, S, n)``."""
        low, high = self.needed
        more = _MARGIN * (high - low) + TINY
        known = torch.isfinite(self.needed).all(0)
        guess = torch.stack(
            [
                torch.where(known, low - more, self.flow.remainder_lower),
                torch.where(known, high + more, self.flow.remainder_upper),
            ]
        )
        return guess.transpose(1, 2)

    def extrapolated(self) -> Tensor:
        """A guess for the periods that follow, ``(2, 1, C, S, n)``."""
        last = torch.nan_to_num(self.needed[:, :, -_SEEN:], nan=0.0, posinf=0.0, neginf=0.0)
        low, high = last[0].amin(1), last[1].amax(1)
        more = _AHEAD * (high - low) + TINY
        return torch.stack([low - more, high + more])[:, None]


@torch.no_grad()
def propagated(
    affine: Affine, loop: SampledLoop, start: Box, w: Box, division: Division, *, foresee: bool = False
) -> FlowRun:
    """Reach sets of cells ``(C, n)`` under signals in ``w (n,)``, or in each period in a box of its own, ``(K, n)``, or
    in each part of one, ``(K, S, n)``.

    Rows of the tube after a period in which no enclosure was found are infinite. What halving the cells would do is
    followed if it is to be foreseen; of remainders it knows nothing.
    """
    programs = expansion(loop, division)
    cells, n, s = start.lower.shape[0], loop.state_dim, division.substeps
    blocks: list[_Block] = []
    states: Zonotope | None = None
    halving = Halving(start) if foresee else None
    guess = torch.zeros(2, 1, cells, s, n, dtype=torch.float64)
    failed = torch.full((cells,), loop.horizon)
    at, length, here = 0, _FIRST, start
    while at < loop.horizon:
        stop = min(at + length, loop.horizon)
        part = RecordedLoop((programs.step,), loop.numbers[at:stop], stop - at)
        signal = w if w.lower.dim() == 1 else Box(w.lower[at:stop], w.upper[at:stop])
        block = _block(affine, part, programs, here, _Begin(states, halving), signal, guess)
        blocks.append(block)
        bad = ~block.holds
        first = torch.where(bad.any(1), bad.to(torch.int8).argmax(1) + at, loop.horizon)
        failed = torch.minimum(failed, first)
        states, halving = block.run.last, block.run.halving
        here = Box(*(_settled(side[:, -1]) for side in (block.run.tube.lower, block.run.tube.upper)))
        guess = block.extrapolated()
        at, length = stop, min(2 * length, _LONGEST)
        if bool((failed < at).all()):  # nothing that follows would count
            break
    run, rest = _joined([b.run for b in blocks]), loop.horizon - at
    between = Flow.join([b.flow for b in blocks], 1)
    assert between is not None
    between = between.padded(rest).known_until(failed)
    tube = Tube(*(torch.nn.functional.pad(side, (0, 0, 0, rest)) for side in (run.tube.lower, run.tube.upper)))
    lost = (torch.arange(loop.horizon + 1) > failed[:, None])[..., None]
    tube = Tube(torch.where(lost, -torch.inf, tube.lower), torch.where(lost, torch.inf, tube.upper))
    return FlowRun(dataclasses.replace(run, tube=tube, bands=[] if rest else run.bands), between, failed)


@dataclass(frozen=True)
class _Begin:
    """How far earlier periods came: the set, and what halving the cells would do; see :meth:`.Affine.run`."""

    states: Zonotope | None
    halving: Halving | None


def _settled(side: Tensor) -> Tensor:
    return torch.nan_to_num(side, nan=0.0, posinf=0.0, neginf=0.0)


def _block(
    affine: Affine,
    part: RecordedLoop,
    programs: Expansion,
    start: Box,
    begin: _Begin,
    w: Box,
    guess: Tensor,
) -> _Block:
    """Some periods in a row, beginning with ``guess (2, 1 or K, C, S, n)`` of their remainders."""
    for _ in range(_ATTEMPTS - 1):
        block = _attempt(affine, part, programs, start, begin, w, guess)
        if bool(block.settled.all()):
            return block
        guess = block.widened()
    return _attempt(affine, part, programs, start, begin, w, guess)


def _attempt(
    affine: Affine, part: RecordedLoop, programs: Expansion, start: Box, begin: _Begin, w: Box, guess: Tensor
) -> _Block:
    """The same with one guess."""
    cells, n = start.lower.shape
    s, steps = programs.division.substeps, part.horizon
    guess = guess.expand(2, steps, cells, s, n)
    signal = [
        (side if side.dim() == 3 else side.expand(steps, n)[:, None])[:, None].expand(steps, cells, s, n)
        for side in (w.lower, w.upper)
    ]
    sides = [torch.cat([side, side, g], -1).flatten(-2) for side, g in zip(signal, guess, strict=True)]
    run = affine.run(part, start, Box(*sides), watch=True, states=begin.states, intervals=False, halving=begin.halving)
    state, control = _boxes(run, n, s)
    each = Box(*(side.transpose(0, 1).reshape(-1, n) for side in signal))
    found = enclosure(programs, state, control, w if w.lower.dim() == 1 else each)

    def shaped(side: Tensor) -> Tensor:
        return side.reshape(cells, steps, s, n)

    given = guess.transpose(1, 2)
    between = Flow(
        programs.division,
        shaped(state.lower),
        shaped(state.upper),
        shaped(found.lower),
        shaped(found.upper),
        given[0],
        given[1],
        shaped(found.curve),
        shaped(found.drift),
    )
    return _Block(run, between, torch.stack([shaped(found.remainder_lower), shaped(found.remainder_upper)]))


def _boxes(run: AffineRun, n: int, s: int) -> tuple[IntervalForm, IntervalForm | None]:
    """States at the beginning of every part and controls of it, ``(C K S, ...)``."""
    lower, upper = run.tube.lower[:, :-1, None], run.tube.upper[:, :-1, None]
    if run.watched_lower is None or run.watched_upper is None:
        return IntervalForm(lower.reshape(-1, n), upper.reshape(-1, n)), None
    states, controls = [], []
    for side, watched in ((lower, run.watched_lower), (upper, run.watched_upper)):
        m = watched.shape[-1] - (s - 1) * n
        states.append(torch.cat([side, watched[..., m:].unflatten(-1, (s - 1, n))], 2) if s > 1 else side)
        controls.append(watched[..., None, :m].expand(*watched.shape[:-1], s, m))
    state = IntervalForm(*(side.reshape(-1, n) for side in states))
    m = controls[0].shape[-1]
    return state, IntervalForm(*(side.reshape(-1, m) for side in controls)) if m else None


def _joined(runs: Sequence[AffineRun]) -> AffineRun:
    """Runs over periods in a row, as one."""

    def rows(side: str) -> Tensor:
        tubes = [getattr(r.tube, side) for r in runs]
        return torch.cat([tubes[0], *(t[:, 1:] for t in tubes[1:])], 1)

    def watched(side: str) -> Tensor | None:
        parts = [getattr(r, side) for r in runs]
        return None if parts[0] is None else torch.cat(parts, 1)

    return AffineRun(
        Tube(rows("lower"), rows("upper")),
        [band for r in runs for band in r.bands],
        [mask for r in runs for mask in r.kept],
        [],
        watched("watched_lower"),
        watched("watched_upper"),
        tuple(dict.fromkeys(note for r in runs for note in r.notes)),
        runs[-1].last,
        runs[-1].halving,
    )
