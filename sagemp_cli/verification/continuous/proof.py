"""The verdict about a loop in continuous time: attacked, bounded cell by cell (:mod:`.refining`), judged."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from sagemp_cli.errors import UsageError
from sagemp_cli.reachability.any_loop import cells_of
from sagemp_cli.reachability.continuous.observed import ObservedOde
from sagemp_cli.reachability.continuous.sampled import SampledLoop
from sagemp_cli.reachability.flow import Division
from sagemp_cli.reachability.propagator import Propagator
from sagemp_cli.scenes.requirements import Formula
from sagemp_cli.sets import Box, Tube
from sagemp_cli.verification.continuous.attack import Found, Violation, search
from sagemp_cli.verification.continuous.judging import Asked
from sagemp_cli.verification.continuous.refining import Piece, Refinement
from sagemp_cli.verification.verdict import Answer

LONGEST_NAME = 50
"""Characters of a requirement's name."""


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
    work = Refinement(seen, propagator, asked, cells_at_once, substeps, order)
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
