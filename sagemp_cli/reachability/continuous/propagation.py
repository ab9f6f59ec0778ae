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
from sagemp_cli.reachability.continuous.enclosure import Held, enclosure, measured_rest
from sagemp_cli.reachability.continuous.expansion import Expansion, expansion
from sagemp_cli.reachability.continuous.lagging import Shares
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
        guess: of the remainders of all parts and then, of a control that lags, of what was measured,
            ``(2, C, K, S + 1, n)``.
        needed: what they have to contain, likewise.
    """

    run: AffineRun
    flow: Flow
    guess: Tensor
    needed: Tensor

    @property
    def holds(self) -> Tensor:
        """Whether they do, ``(C, K)``."""
        inside = (self.guess[0] <= self.needed[0]) & (self.needed[1] <= self.guess[1])
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
        return torch.where(known, torch.stack([low - more, high + more]), self.guess).transpose(1, 2)

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
    if programs.lags:  # of a control before the first there is none: 0 stands for it and moves nothing
        nothing = torch.zeros(cells, loop.controls, dtype=torch.float64)
        start = Box(torch.cat([start.lower, nothing], -1), torch.cat([start.upper, nothing], -1))
    blocks: list[_Block] = []
    states: Zonotope | None = None
    halving = Halving(start) if foresee else None
    guess = torch.zeros(2, 1, cells, s + programs.jitter, n, dtype=torch.float64)
    failed = torch.full((cells,), loop.horizon)
    at, length, here = 0, _FIRST, start
    while at < loop.horizon:
        stop = min(at + length, loop.horizon)
        part = RecordedLoop((programs.step,), loop.numbers[at:stop], stop - at)
        signal = w if w.lower.dim() == 1 else Box(w.lower[at:stop], w.upper[at:stop])
        given = _Given(
            part, programs, here, _Begin(states, halving), signal, *_lag(loop, programs, at, stop, w, blocks)
        )
        block = _block(affine, given, guess)
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
    sides = (run.tube.lower[..., :n], run.tube.upper[..., :n])
    tube = Tube(*(torch.nn.functional.pad(side, (0, 0, 0, rest)) for side in sides))
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


@dataclass(frozen=True)
class _Given:
    """What is known of some periods before they are propagated.

    Attributes:
        part: their steps.
        programs: of the loop.
        start: box of the states, ``(C, n)``; of a control that lags, with the control before.
        begin: what else is known of them.
        w: W, ``(n,)`` or of each period.
        shares: what a lag leaves of every part to the control before; None if there is none.
        earlier: of the period before the first of these, W ``(n,)`` and boxes that the flow did not leave,
            ``(C, S, n)``, where what is measured may be of that time.
    """

    part: RecordedLoop
    programs: Expansion
    start: Box
    begin: _Begin
    w: Box
    shares: Shares | None
    earlier: tuple[Box, Box] | None


def _lag(
    loop: SampledLoop, programs: Expansion, at: int, stop: int, w: Box, blocks: Sequence[_Block]
) -> tuple[Shares | None, tuple[Box, Box] | None]:
    """The last two of :class:`_Given`, of periods from ``at`` on."""
    if loop.lag is None or not programs.lags:
        return None, None
    shares = Shares.of(loop.lag, at, stop, loop.period, programs.division)
    if not at or not programs.jitter:
        return shares, None
    before = w if w.lower.dim() == 1 else Box(w.lower[at - 1], w.upper[at - 1])
    flow = blocks[-1].flow
    return shares, (before, Box(flow.lower[:, -1], flow.upper[:, -1]))


def _block(affine: Affine, given: _Given, guess: Tensor) -> _Block:
    """Some periods in a row, beginning with ``guess (2, 1 or K, C, S, n)`` of their remainders."""
    for _ in range(_ATTEMPTS - 1):
        block = _attempt(affine, given, guess)
        if bool(block.settled.all()):
            return block
        guess = block.widened()
    return _attempt(affine, given, guess)


def _attempt(affine: Affine, given: _Given, guess: Tensor) -> _Block:
    """The same with one guess."""
    programs, part, w, shares = given.programs, given.part, given.w, given.shares
    cells, n, s, steps = len(given.start.lower), programs.rate.states, programs.division.substeps, part.horizon
    guess = guess.expand(2, steps, *guess.shape[2:])
    signal = [
        (side if side.dim() == 3 else side.expand(steps, n)[:, None])[:, None].expand(steps, cells, s, n)
        for side in (w.lower, w.upper)
    ]
    if shares is None:
        sides = [torch.cat([side, side, g], -1).flatten(-2) for side, g in zip(signal, guess, strict=True)]
    else:
        if programs.jitter:  # what is measured at once is the state
            older = (shares.jitter[1] > 0)[:, None, None, None]
            guess = torch.cat([guess[:, :, :, :s], torch.where(older, guess[:, :, :, s:], 0.0)], 3)
        sides = [_lagging(given, shares, guess[i], i) for i in (0, 1)]
    run = affine.run(
        part,
        given.start,
        Box(*sides),
        watch=True,
        states=given.begin.states,
        intervals=False,
        halving=given.begin.halving,
    )
    state, control = _boxes(run, n, programs.rate.numbers, s)
    held = None if shares is None else _held(run, shares, programs)
    each = Box(*(side.transpose(0, 1).reshape(-1, n) for side in signal))
    found = enclosure(programs, state, control, w if w.lower.dim() == 1 else each, held)

    def shaped(side: Tensor) -> Tensor:
        return side.reshape(cells, steps, s, n)

    needed = torch.stack([shaped(found.remainder_lower), shaped(found.remainder_upper)])
    if programs.jitter:
        assert shares is not None
        rest = _measured(run, given, shares, shaped(found.lower), shaped(found.upper))
        needed = torch.cat([needed, torch.stack(rest)[:, :, :, None]], 3)
    own = guess.transpose(1, 2)
    none = torch.zeros(cells, steps, 1, n, dtype=torch.float64)
    measured = own[:, :, :, s:] if programs.jitter else torch.stack([none, none])
    between = Flow(
        programs.division,
        shaped(state.lower),
        shaped(state.upper),
        shaped(found.lower),
        shaped(found.upper),
        own[0, :, :, :s],
        own[1, :, :, :s],
        shaped(found.curve),
        shaped(found.drift),
        torch.zeros(cells, steps, s, n, dtype=torch.float64) if held is None else shaped(held.jump),
        measured[0],
        measured[1],
    )
    return _Block(run, between, own, needed)


def _lagging(given: _Given, shares: Shares, guess: Tensor, side: int) -> Tensor:
    """A side of the disturbance of periods whose control lags, ``(K, C, d)``; of a guess ``(K, C, S + 1, n)``."""
    steps, cells, _, n = guess.shape
    s, w = given.programs.division.substeps, _side(given.w, side).expand(steps, n)
    signal, found = w[:, None].expand(steps, cells, n), []
    if given.programs.jitter:
        first = w[:1] if given.earlier is None else _side(given.earlier[0], side)[None]
        before = torch.cat([first, w[:-1]])[:, None].expand(steps, cells, n)
        found += [shares.jitter[side][:, None, None].expand(steps, cells, 1), before, guess[:, :, s]]
    for j in range(s):
        found += [signal, signal, guess[:, :, j]]
        if j < shares.parts:
            found.append((shares.means.lower, shares.means.upper)[side][:, None, j].expand(steps, cells, 2))
    return torch.cat(found, -1)


def _boxes(run: AffineRun, n: int, m: int, s: int) -> tuple[IntervalForm, IntervalForm | None]:
    """States at the beginning of every part and controls of it, ``(C K S, ...)``."""
    lower, upper = run.tube.lower[:, :-1, None, :n], run.tube.upper[:, :-1, None, :n]
    if run.watched_lower is None or run.watched_upper is None:
        return IntervalForm(lower.reshape(-1, n), upper.reshape(-1, n)), None
    states, controls = [], []
    for side, watched in ((lower, run.watched_lower), (upper, run.watched_upper)):
        inner = watched[..., m : m + (s - 1) * n].unflatten(-1, (s - 1, n)) if s > 1 else side[:, :, :0]
        states.append(torch.cat([side, inner], 2))
        controls.append(watched[..., None, :m].expand(*watched.shape[:-1], s, m))
    state = IntervalForm(*(side.reshape(-1, n) for side in states))
    return state, IntervalForm(*(side.reshape(-1, m) for side in controls)) if m else None


def _held(run: AffineRun, shares: Shares, programs: Expansion) -> Held | None:
    """What the control before may do in every part, ``(C K S, ...)``; None if there is no delay."""
    lagged, s, n, m = programs.lagged, programs.division.substeps, programs.rate.states, programs.rate.numbers
    if not lagged or run.watched_lower is None or run.watched_upper is None:
        return None
    watched = run.watched_lower, run.watched_upper
    rows = watched[0].shape[:-1]
    there = torch.nn.functional.pad(shares.most, (0, s - lagged))[..., None] > 0

    def spread(share: Tensor) -> Tensor:
        whole = torch.nn.functional.pad(share, (0, s - lagged))[..., None]
        return whole.expand(*rows, s, 1).reshape(-1, 1)

    def parts(sides: Sequence[Tensor], missing: Sequence[Tensor]) -> IntervalForm:
        return IntervalForm(
            *(
                torch.where(there, a, b).expand(*rows, s, a.shape[-1]).reshape(-1, a.shape[-1])
                for a, b in zip(sides, missing, strict=True)
            )
        )

    first = m + (s - 1) * n
    control = [side[..., None, :m] for side in watched]
    before = [side[..., :-1, None, n:] for side in (run.tube.lower, run.tube.upper)]
    both = torch.minimum(control[0], before[0]), torch.maximum(control[1], before[1])
    none = [torch.zeros(1, dtype=torch.float64)] * 2
    less = parts([side[..., None, first + lagged * n :] for side in watched], none)
    low, high = (side[..., first : first + lagged * n].unflatten(-1, (lagged, n)) for side in watched)
    jump = torch.nn.functional.pad(torch.maximum(low.abs(), high.abs()), (0, 0, 0, s - lagged))
    return Held(
        parts(both, control),
        less,
        torch.where(there, torch.nan_to_num(jump, nan=torch.inf, posinf=torch.inf), 0.0).reshape(-1, n),
        spread(shares.most),
        spread(shares.means.upper[..., 0]),
        spread(shares.swing),
    )


def _measured(run: AffineRun, given: _Given, shares: Shares, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """What is left out of measured states, ``(C, K, n)``, of boxes that flows stay in, ``(C, K, S, n)``."""
    cells, steps, s, n = lower.shape
    period = given.programs.length * s
    since = shares.since(period, s)
    sides, signals = [], []
    for i, side in enumerate((lower, upper)):
        first = side[:, :1] if given.earlier is None else _side(given.earlier[1], i)[:, None]
        before = torch.cat([first, side[:, :-1]], 1)[:, :, since:]
        sides.append((before.amax(2) if i else before.amin(2)).reshape(-1, n))
        w = _side(given.w, i).expand(steps, n)
        row = w[:1] if given.earlier is None else _side(given.earlier[0], i)[None]
        signals.append(torch.cat([row, w[:-1]]).expand(cells, steps, n).reshape(-1, n))
    control = IntervalForm(*(t[:, :-1, n:].reshape(cells * steps, -1) for t in (run.tube.lower, run.tube.upper)))
    older = [side.expand(cells, steps).reshape(-1, 1) for side in shares.jitter]
    rest = measured_rest(given.programs, IntervalForm(*sides), control, Box(*signals), (older[0], older[1]))
    return rest[0].reshape(cells, steps, n), rest[1].reshape(cells, steps, n)


def _side(box: Box, side: int) -> Tensor:
    return box.upper if side else box.lower


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
