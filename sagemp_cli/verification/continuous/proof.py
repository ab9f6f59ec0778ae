"""The verdict about a loop in continuous time: attacked, bounded cell by cell, judged.

Cells whose proof fails are tried again. Where the remainders of the Taylor polynomials are a noticeable share of the
tube, more parts a period are taken; else the cells are halved, each in the state whose halves are foreseen to miss
least together. Where a tube explodes before the end, what its first periods say decides both (:meth:`_Work.narrowed`).
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sagemp_cli.errors import UsageError
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.any_loop import cells_of
from sagemp_cli.reachability.continuous.division import (
    ENOUGH,
    FINE,
    finer,
    periods_lost,
    remainder_share,
)
from sagemp_cli.reachability.continuous.observed import ObservedOde
from sagemp_cli.reachability.continuous.reach import reach_continuously
from sagemp_cli.reachability.continuous.sampled import SampledLoop
from sagemp_cli.reachability.continuous.trial import TRIED, suggested
from sagemp_cli.reachability.flow import Division, Flow
from sagemp_cli.reachability.halves import Halves
from sagemp_cli.reachability.propagator import Propagator, Reach
from sagemp_cli.reachability.recording import Recording
from sagemp_cli.scenes.requirements import Formula
from sagemp_cli.sets import Box, Tube
from sagemp_cli.sets.partition import halved
from sagemp_cli.verification.continuous.attack import Found, Violation, search
from sagemp_cli.verification.continuous.judging import Asked, Judgement, foreseen_missing, judged
from sagemp_cli.verification.cutting import best_cut, cut_gains
from sagemp_cli.verification.verdict import Answer

LONGEST_NAME = 50
"""Characters of a requirement's name."""

_PATIENCE = 3
"""Halvings in a row that may be in vain, before the rest is given up."""

_GAIN = 0.02
"""A halving is in vain if what is missing falls by less than this share of it."""

_WORTH = 0.05
"""Of cells whose tubes explode: by how much, as the mean of logarithms, a change must narrow the tube of the first
periods for the next one to be made before they are bounded again."""

SYMBOLS = 100
"""Generators that are kept for each state, where nobody says how many."""


@dataclass(frozen=True)
class Piece:
    """Some cells that were bounded in one call.

    Attributes:
        cells: ``(C, n)``.
        reach: of them.
        judgement: what that proves.
    """

    cells: Box
    reach: Reach
    judgement: Judgement

    @property
    def bounded(self) -> bool:
        """Whether all of its tubes are, up to the end."""
        return bool(self.reach.tube.bounded.all())

    def of(self, index: Tensor) -> Piece:
        """The same for some of the cells."""
        r, j = self.reach, self.judgement
        assert r.flow is not None
        controls = [None if side is None else side[index] for side in (r.control_lower, r.control_upper)]
        return Piece(
            Box(self.cells.lower[index], self.cells.upper[index]),
            replace(
                r,
                tube=Tube(r.tube.lower[index], r.tube.upper[index]),
                control_lower=controls[0],
                control_upper=controls[1],
                recording=None if r.recording is None else r.recording.select(index),
                flow=r.flow.select(index),
                halves=None if r.halves is None else r.halves.select(index),
            ),
            Judgement(j.margin[index], j.time[index], j.holds[index], j.missing[index]),
        )


@dataclass(frozen=True)
class RequirementVerdict:
    """What is known of a requirement.

    Attributes:
        name: of it.
        answer: about it alone.
        margin: certain for all solutions, at least; what a violation misses by, negative, if there is one.
        time: in seconds, when the margin is so small, or the first time at which it is not proved, or is broken.
    """

    name: str
    answer: Answer
    margin: float
    time: float


@dataclass(frozen=True)
class OdeProof:
    """What was found out about a loop in continuous time.

    Attributes:
        loop: the recorded programs that it is about.
        start, disturbance: X_I and W.
        requirements: what was asked, as programs.
        pieces: all cells; together they cover X_I.
        verdicts: one for each requirement.
        bounded: whether all states were bounded up to the end.
        violation: a solution that breaks a requirement, if one was found.
        rollouts: so many were simulated in looking for one.
        seconds: of processor time.
        notes: of the propagator.
        propagator: its name.
    """

    loop: SampledLoop
    start: Box
    disturbance: Box
    requirements: tuple[Asked, ...]
    pieces: tuple[Piece, ...]
    verdicts: tuple[RequirementVerdict, ...]
    bounded: bool
    violation: Violation | None
    rollouts: int
    seconds: float
    notes: tuple[str, ...]
    propagator: str

    @property
    def answer(self) -> Answer:
        """VERIFIED, FALSIFIED or UNKNOWN."""
        answers = {v.answer for v in self.verdicts}
        if Answer.FALSIFIED in answers:
            return Answer.FALSIFIED
        return Answer.VERIFIED if self.bounded and answers <= {Answer.VERIFIED} else Answer.UNKNOWN

    @property
    def cells(self) -> int:
        """Number of cells."""
        return sum(len(p.cells.lower) for p in self.pieces)

    @property
    def divisions(self) -> tuple[Division, ...]:
        """How the period was cut for some of the cells, each division once."""
        return tuple(dict.fromkeys(p.reach.flow.division for p in self.pieces if p.reach.flow is not None))

    @property
    def tube(self) -> Tube:
        """Around all solutions at the instants, ``(K+1, n)``."""
        tubes = [p.reach.tube.hull() for p in self.pieces]
        return Tube(torch.stack([t.lower for t in tubes]).amin(0), torch.stack([t.upper for t in tubes]).amax(0))

    @property
    def between(self) -> Box:
        """Around all solutions over each period, ``(K, n)``."""
        flows = [p.reach.flow for p in self.pieces if p.reach.flow is not None]
        return Box(
            torch.stack([f.lower.amin((0, 2)) for f in flows]).amin(0),
            torch.stack([f.upper.amax((0, 2)) for f in flows]).amax(0),
        )


def verify_ode(
    seen: ObservedOde,
    propagator: Propagator,
    formulas: Sequence[Formula],
    *,
    counts: Sequence[int] | None,
    budget: int = 64,
    cells_at_once: int = 64,
    substeps: int | None = None,
    order: int | None = None,
    restarts: int = 1,
    generator: torch.Generator,
) -> OdeProof:
    """Attack, bound and judge a loop in continuous time.

    Args:
        seen: the recorded loop, its start box and its disturbance box.
        propagator: bounds it.
        formulas: what is to be proved at all times; nothing asks for a bounded tube only.
        counts: cells per uncertain start dimension; None where more are taken as the proof needs them.
        budget: cells at most then.
        cells_at_once: cells in one call of the propagator.
        substeps, order: see :func:`~sagemp_cli.reachability.continuous.reach.reach_continuously`.
        restarts: 0 for no attack.
        generator: draws where attacks begin.

    Raises:
        UsageError: functions that are found to differ from what was recorded of them, or a requirement that does not
            fit.
        UnsupportedOperationError: what cannot be bounded in continuous time.
    """
    began = time.process_time()
    example = seen.start.center
    formulas = _named(formulas)
    asked = [Asked.of(f, seen.loop, example) for f in formulas]
    found = Found(None, 0)
    if restarts:
        found = search(seen.loop, seen.start, seen.disturbance, asked, generator=generator, ascents=False)
    violation, rollouts = found.violation, found.rollouts
    if violation is not None and violation.proved:
        return _refuted(seen, asked, found, propagator, time.process_time() - began)
    work = _Work(seen, propagator, asked, cells_at_once, substeps, order)
    cells = cells_of(seen.start, counts or [])
    pieces = work.proved(cells, budget if counts is None else 0)
    for piece in pieces:
        seen.compare(piece.reach)
    verdicts = _verdicts(asked, pieces)
    bounded = all(p.bounded for p in pieces)
    if restarts and any(v.answer is not Answer.VERIFIED for v in verdicts):
        open_ones = [a for a, v in zip(asked, verdicts, strict=True) if v.answer is not Answer.VERIFIED]
        more = search(seen.loop, seen.start, seen.disturbance, open_ones, generator=generator, ascents=True)
        rollouts += more.rollouts
        violation = more.violation if more.violation is not None else violation
    if violation is not None:
        for i, v in enumerate(verdicts):
            if v.name == violation.requirement and violation.proved:
                verdicts[i] = RequirementVerdict(v.name, Answer.FALSIFIED, -violation.depth, violation.time)
    notes = tuple(dict.fromkeys(note for p in pieces for note in p.reach.notes))
    return OdeProof(
        seen.loop,
        seen.start,
        seen.disturbance,
        tuple(asked),
        tuple(pieces),
        tuple(verdicts),
        bounded,
        violation,
        rollouts,
        time.process_time() - began,
        notes,
        propagator.name,
    )


def _named(formulas: Sequence[Formula]) -> list[Formula]:
    """The same with names of their own: the second ``inside`` is ``inside 2``."""
    used: set[str] = set()
    found = []
    for formula in formulas:
        if not isinstance(formula.name, str) or not 0 < len(formula.name) <= LONGEST_NAME:
            raise UsageError(f"the name of a requirement has 1 to {LONGEST_NAME} characters, found {formula.name!r}")
        names = itertools.chain([formula.name], (f"{formula.name} {i}" for i in itertools.count(2)))
        name = next(name for name in names if name not in used)
        used.add(name)
        found.append(replace(formula, name=name))
    return found


class _Work:
    """Bounds and judges cells."""

    def __init__(
        self,
        seen: ObservedOde,
        propagator: Propagator,
        asked: Sequence[Asked],
        at_once: int,
        substeps: int | None,
        order: int | None,
    ) -> None:
        if isinstance(propagator, Affine) and propagator.symbols is None:
            propagator = replace(propagator, symbols=SYMBOLS * seen.loop.state_dim)
        self.loop, self.w, self.propagator, self.asked, self.at_once = (
            seen.loop,
            seen.disturbance,
            propagator,
            asked,
            at_once,
        )
        self.given = {"substeps": substeps, "order": order}

    def proved(self, cells: Box, budget: int) -> list[Piece]:
        """Pieces that cover the cells, halved up to a budget where their proof fails."""
        division = suggested(self.propagator, self.loop, cells, self.w, **self.given)
        done: list[Piece] = []
        piece, vain, refines = self.piece(cells, division), 0, True
        while True:
            open_ones = ~piece.judgement.holds.all(1)
            done.append(piece.of(torch.nonzero(~open_ones)[:, 0]))
            piece = piece.of(torch.nonzero(open_ones)[:, 0])
            count = len(piece.cells.lower)
            if not count:
                break
            room = budget - sum(len(p.cells.lower) for p in done)
            if not piece.bounded and 2 * count <= room:
                cells, better = self.narrowed(piece, division, room)
                if better != division or len(cells.lower) > count:
                    piece, division, refines = self.piece(cells, better), better, True
                    continue
            more = finer(division, **self.given) if refines and self.coarse(piece) else None
            if more is not None:
                again = self.piece(piece.cells, more)
                refines = float(again.judgement.missing.sum()) < (1 - _GAIN) * float(piece.judgement.missing.sum())
                if refines:
                    piece, division = again, more
                    continue
            if 2 * count > room or vain >= _PATIENCE:
                break
            before = float(piece.judgement.missing.sum())
            halves = self.halved(piece, division)
            if halves is None:
                break
            piece = halves
            vain = vain + 1 if float(piece.judgement.missing.sum()) > 2 * (1 - _GAIN) * before else 0
        return [p for p in (*done, piece) if len(p.cells.lower)]

    def narrowed(self, piece: Piece, division: Division, most: int) -> tuple[Box, Division]:
        """Cells whose tubes explode, halved, each in the state in which that is foreseen to narrow the tube of the
        first periods most, or their periods divided finer, if that does more; as long as it does a good deal. What
        makes a tube explode is there from the beginning.
        """
        first, cells = self.loop.beginning(min(TRIED, self.loop.horizon)), piece.cells
        share, more = float(remainder_share(piece.reach).mean()), finer(division, **self.given)
        reach, halvings = _first(piece.reach, first.horizon), 0
        most_halvings = 1 + round(2 * periods_lost(piece.reach) / self.loop.horizon)
        while halvings < most_halvings and 2 * len(cells.lower) <= most:
            assert reach.halves is not None
            gains, states = cut_gains(cells, reach.tube, reach.halves).max(1)
            gain = float(gains.mean())
            # Remainders add up: a finer division would gain what they are on average over these periods.
            if more is not None and (share * (first.horizon + 1) / 2 > gain or not bool(reach.tube.bounded.all())):
                again = self.reach(first, cells, more)
                if float((_log_widths(reach.tube) - _log_widths(again.tube)).mean()) > max(gain, _WORTH):
                    reach, division, more = again, more, None
                    continue
            if not gain > (_WORTH if halvings else 0.0):
                break
            cells, halvings, more = halved(cells, states), halvings + 1, None
            if halvings < most_halvings:
                reach = self.reach(first, cells, division)
        return cells, division

    def coarse(self, piece: Piece) -> bool:
        """Whether more parts would help: a tube that explodes does so for other reasons if remainders are small."""
        return bool((remainder_share(piece.reach) > (FINE if piece.bounded else ENOUGH)).any())

    def piece(self, cells: Box, division: Division) -> Piece:
        """Cells bounded and judged."""
        reach = self.reach(self.loop, cells, division)
        return Piece(cells, reach, judged(reach, self.asked, self.loop, self.w))

    def reach(self, loop: SampledLoop, cells: Box, division: Division) -> Reach:
        """Cells bounded, all periods or the first ones, and what halving them would do, which costs next to nothing."""
        return _joined(
            [
                reach_continuously(
                    self.propagator,
                    loop,
                    Box(low, high),
                    self.w,
                    substeps=division.substeps,
                    order=division.order,
                    foresee=True,
                )
                for low, high in zip(cells.lower.split(self.at_once), cells.upper.split(self.at_once), strict=True)
            ]
        )

    def halved(self, piece: Piece, division: Division) -> Piece | None:
        """The halves of all cells, each in the state whose halves are foreseen to miss least; None if one cannot be."""
        reach = piece.reach
        assert reach.halves is not None

        def missing(tube: Tube) -> Tensor:
            return foreseen_missing(tube, self.asked, self.loop)

        cut = best_cut(piece.cells, reach.tube, reach.halves, missing)
        return None if bool((cut < 0).any()) else self.piece(halved(piece.cells, cut), division)


def _first(reach: Reach, periods: int) -> Reach:
    """The tubes of the first periods alone, and what halving would do to them."""
    tube, halves = reach.tube, reach.halves
    assert halves is not None
    steps = slice(periods + 1)
    cut = Halves(halves.shift[:, :, steps], halves.narrowing[:, :, steps])
    return Reach(Tube(tube.lower[:, steps], tube.upper[:, steps]), halves=cut)


def _log_widths(tube: Tube) -> Tensor:
    """Of each cell, the mean logarithm of the widths after the start; huge where one is infinite."""
    width = torch.nan_to_num(tube.width[:, 1:], nan=1e300, posinf=1e300)
    return width.clamp(1e-200, 1e300).log().mean((1, 2))


def _joined(reaches: Sequence[Reach]) -> Reach:
    """Of the same loop and division, as one."""
    if len(reaches) == 1:
        return reaches[0]
    flows = [r.flow for r in reaches if r.flow is not None]
    lower, upper = ([getattr(r, f"control_{side}") for r in reaches] for side in ("lower", "upper"))
    known = all(side is not None for side in (*lower, *upper))
    return Reach(
        Tube(*(torch.cat([getattr(r.tube, side) for r in reaches]) for side in ("lower", "upper"))),
        torch.cat(lower) if known else None,
        torch.cat(upper) if known else None,
        Recording.join([r.recording for r in reaches]),
        tuple(dict.fromkeys(note for r in reaches for note in r.notes)),
        Flow.join(flows),
        Halves.join([r.halves for r in reaches]),
    )


def _verdicts(asked: Sequence[Asked], pieces: Sequence[Piece]) -> list[RequirementVerdict]:
    found = []
    for i, one in enumerate(asked):
        margin = torch.cat([p.judgement.margin[:, i] for p in pieces])
        when = torch.cat([p.judgement.time[:, i] for p in pieces])
        holds = torch.cat([p.judgement.holds[:, i] for p in pieces])
        proved = bool(holds.all())
        time_of = float(when[margin.argmin()]) if proved else float(when[~holds].min())
        answer = Answer.VERIFIED if proved else Answer.UNKNOWN
        found.append(RequirementVerdict(one.formula.name, answer, float(margin.min()), time_of))
    return found


def _refuted(
    seen: ObservedOde, asked: Sequence[Asked], found: Found, propagator: Propagator, seconds: float
) -> OdeProof:  # fmt: skip
    """The verdict where a violation was found before anything was bounded."""
    violation = found.violation
    assert violation is not None
    verdicts = [
        RequirementVerdict(a.formula.name, Answer.FALSIFIED, -violation.depth, violation.time)
        if a.formula.name == violation.requirement
        else RequirementVerdict(a.formula.name, Answer.UNKNOWN, -math.inf, 0.0)
        for a in asked
    ]
    return OdeProof(
        seen.loop,
        seen.start,
        seen.disturbance,
        tuple(asked),
        (),
        tuple(verdicts),
        False,
        violation,
        found.rollouts,
        seconds,
        (),
        propagator.name,
    )
