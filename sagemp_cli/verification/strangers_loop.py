"""The verdict about a stranger's loop: its recorded program bounded, judged and attacked as our own loops are.

There is no robot, no tracker and no reference here: the loop is a program, and the claim is that from every start in
X_I and under every disturbance its states, and the straight lines between them unless only the samples are asked for,
keep clear of what a scene says, and are in a goal at step K, as far as there is a scene and a goal.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor

from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.errors import UsageError
from sagemp_cli.problem import Problem
from sagemp_cli.reachability.any_loop import cells_of
from sagemp_cli.reachability.foreseeing import reach_foreseeing
from sagemp_cli.reachability.observed import Observed
from sagemp_cli.reachability.program.loops import RecordedLoop
from sagemp_cli.reachability.propagator import Propagator
from sagemp_cli.reachability.unbounded import why_unbounded
from sagemp_cli.scenes.scene import Scene
from sagemp_cli.sets import Between, Box, Tube
from sagemp_cli.sets.between import moment
from sagemp_cli.verification.adaptive import adaptive_cells
from sagemp_cli.verification.attack.ascent import simulate
from sagemp_cli.verification.attack.falsifier import Counterexample, falsify, margins
from sagemp_cli.verification.attack.refutation import RATES, SHORT_RATES, SoundnessError
from sagemp_cli.verification.cells import CellTubes
from sagemp_cli.verification.cutting import best_cut
from sagemp_cli.verification.verdict import Answer, Outcome, Verdict, answer_of, assess, shortfall
from sagemp_cli.verification.verification import Verification
from sagemp_cli.workers import one_thread


@dataclass(frozen=True)
class LoopClaim:
    """What is to be proved of a loop.

    Attributes:
        scene: workspace and obstacles over the position, goal over the state; infinite where nothing is asked for.
        position: entries of the state that are the position.
        state_names: n names.
        between: whether the loop is claimed to keep clear along straight lines between its samples too. Whether it
            moves along them is for those to say who know what it is a model of.
    """

    scene: Scene
    position: tuple[int, ...]
    state_names: tuple[str, ...]
    between: Between = Between.SEGMENTS

    def unknowns(self, disturbance: Box) -> Box:
        """What is unknown of every step: w alone."""
        return disturbance

    @property
    def bounds_the_position(self) -> bool:
        """Whether there is a workspace."""
        return self.scene.workspace.has_faces

    @property
    def has_goal(self) -> bool:
        """Whether there is a goal."""
        return self.scene.goal.has_faces

    @property
    def asks(self) -> bool:
        """Whether anything is asked for; if not, a tube that stays bounded is all that is proved."""
        return self.bounds_the_position or bool(self.scene.obstacles) or self.has_goal


@dataclass(frozen=True)
class LoopProof:
    """What was found out about a loop.

    Attributes:
        loop: the recorded program that it is about.
        claim: what was asked.
        verification: one "reference", whose states in ``references`` are NaN: a loop has none.
        counterexample: a rollout that refutes the claim, proved in rigorous arithmetic.
        unproved: one that breaks it in float64 only, which refutes nothing.
        rollouts: that the attack tried.
    """

    loop: RecordedLoop
    claim: LoopClaim
    verification: Verification
    counterexample: Counterexample | None
    unproved: Counterexample | None
    rollouts: int

    @property
    def answer(self) -> Answer:
        """VERIFIED, FALSIFIED or UNKNOWN."""
        return answer_of(self.verification.verdicts)

    @property
    def tube(self) -> Tube:
        """Around all rollouts, ``(K+1, n)``."""
        return self.verification.tube.hull()


def verify_loop(
    seen: Observed,
    propagator: Propagator,
    claim: LoopClaim,
    *,
    counts: Sequence[int] | None,
    budget: int = 64,
    cells_at_once: int = 64,
    restarts: int = 16,
    generator: torch.Generator,
) -> LoopProof:
    """Bound, judge and attack a loop.

    Args:
        seen: the recorded loop, its start box and its disturbance box.
        propagator: bounds it.
        claim: what is to be proved.
        counts: cells per uncertain start dimension, all of them 1 if there is none; None for an adaptive partition.
        budget: cells at most, in an adaptive partition.
        cells_at_once: cells in one call of the propagator.
        restarts: ascents of the attack per constraint, if the claim is not proved; a few if it is.
        generator: draws where they begin.

    Raises:
        UsageError: the step is found to differ from what was recorded of it.
        SoundnessError: a claim that was proved is refuted.
    """
    if claim.scene.goal.dim != seen.start.dim or len(claim.state_names) != seen.start.dim:
        raise UsageError(f"the loop has {seen.start.dim} states, the claim speaks of {claim.scene.goal.dim}")
    work = _Cells(seen, propagator, cells_at_once, claim if counts is None else None)
    if counts is None:
        found = adaptive_cells(
            work,
            Box(seen.start.lower[None], seen.start.upper[None]),
            budget=budget,
            shortfall=lambda found: _shortfall(found.tube, claim),
            hopeless=lambda owner, cells: _breaks(seen, claim, cells),
        )
    else:
        cells = cells_of(seen.start, counts)
        found = work(torch.zeros(len(cells.lower), dtype=torch.int64), cells)
    seen.compare(found.cells, found.tube.hull())
    judged = assess(
        found.tube,
        claim.scene,
        cell_reference=found.cell_reference,
        position=claim.position,
        state_names=claim.state_names,
        between=claim.between,
    )
    n, steps, bounded = seen.start.dim, seen.loop.horizon, judged.verdicts[0].outcome is not Outcome.UNBOUNDED
    first = 0 if claim.bounds_the_position else 1  # a workspace that is not there is no constraint
    verification = Verification(
        references=torch.full((1, steps + 1, n), torch.nan, dtype=torch.float64),
        start=Box(seen.start.lower[None], seen.start.upper[None]),
        disturbance=seen.disturbance,
        cell_reference=found.cell_reference,
        cells=found.cells,
        tube=found.tube,
        control_lower=found.control_lower.amin(0, keepdim=True),
        control_upper=found.control_upper.amax(0, keepdim=True),
        verdicts=judged.verdicts,
        constraint_names=claim.scene.constraint_names[first:],
        clearance=judged.clearance[:, first:],
        goal_margin=judged.goal_margin,
        seconds=found.seconds.sum(0, keepdim=True),
        propagator=propagator.name,
        rigorous=propagator.rigorous,
        recording=found.recording,
        notes=(
            *found.notes,
            *(() if bounded else (f"unbounded: {why_unbounded(seen.loop, found.tube, seen.disturbance)}",)),
        ),
        between=claim.between,
    )
    return _attacked(seen, claim, verification, restarts, generator)


class _Cells:
    """Proves cells in chunks, and says where they are best cut if a claim is given."""

    def __init__(self, seen: Observed, propagator: Propagator, at_once: int, claim: LoopClaim | None) -> None:
        self.seen, self.propagator, self.at_once, self.claim = seen, propagator, at_once, claim

    def __call__(self, owner: Tensor, cells: Box) -> CellTubes:
        chunks = zip(*(x.split(self.at_once) for x in (owner, cells.lower, cells.upper)), strict=True)
        return CellTubes.join([self._proved(own, Box(low, high)) for own, low, high in chunks])

    def _proved(self, owner: Tensor, cells: Box) -> CellTubes:
        loop, began, claim = self.seen.loop, time.perf_counter(), self.claim
        with torch.no_grad(), one_thread():
            reach = type(self.propagator).reach if claim is None else reach_foreseeing
            found = reach(self.propagator, loop, cells, self.seen.disturbance, watch=True)
            cut = None
            if found.halves is not None and claim is not None:
                cut = best_cut(cells, found.tube, found.halves, lambda tube: _shortfall(tube, claim)[1])
        seconds = torch.full((len(owner),), (time.perf_counter() - began) / len(owner), dtype=torch.float64)
        nothing = torch.zeros(len(owner), loop.horizon, 0, dtype=torch.float64)
        return CellTubes(owner, cells, found.tube, nothing, nothing, seconds, found.recording, found.notes, cut=cut)


def _shortfall(tube: Tube, claim: LoopClaim) -> tuple[Tensor, Tensor]:
    safe, missing = shortfall(tube, claim.scene, position=claim.position, between=claim.between)
    return safe, torch.nan_to_num(missing, nan=1e300, posinf=1e300)


def _breaks(seen: Observed, claim: LoopClaim, cells: Box) -> Tensor:
    """Whether a rollout from the centre of each cell breaks the claim in float64, ``(B,)``, which proves nothing."""
    x = cells.center
    w = seen.disturbance.center.expand(len(x), seen.loop.horizon, -1)
    with torch.no_grad():
        states = simulate(seen.loop, x, w)
    return (margins(states, _problem(seen, claim)) < 0).flatten(1).any(1)


def _problem(seen: Observed, claim: LoopClaim) -> Problem:
    """The claim as attacks want it. Of the robot, which there is none, they ask only where the position is."""
    robot = cast(Dynamics, claim)
    return Problem(robot, claim.scene, seen.start, seen.disturbance, seen.loop.horizon, claim.between)


def _attacked(
    seen: Observed, claim: LoopClaim, verification: Verification, restarts: int, generator: torch.Generator
) -> LoopProof:
    """With what an attack found: a refuted claim is UNSAFE."""
    safe = verification.verdicts[0].outcome is Outcome.SAFE
    starts, rates = (min(restarts, 2), SHORT_RATES) if safe else (restarts, RATES)
    example = None
    if starts > 0 and claim.asks:
        (example,) = falsify(
            seen.loop,
            _problem(seen, claim),
            generator=generator,
            restarts=starts,
            rates=rates,
        )
    rollouts = starts * (len(claim.scene.constraint_names) + 1) * (len(rates) + 1) if claim.asks else 0
    if example is None or not example.proved:
        return LoopProof(seen.loop, claim, verification, None, None if safe else example, rollouts)
    name = f"goal {claim.state_names[example.state]}" if example.kind == "goal" else example.name
    if safe:
        raise SoundnessError(
            f"the loop was certified by '{verification.propagator}', but a replayed rollout breaks '{name}' at "
            f"{moment(example.step, example.fraction)} by {example.depth:.3g}; please report this"
        )
    verdicts = (Verdict(Outcome.UNSAFE, example.step, name, example.fraction),)
    refuted = dataclasses.replace(verification, verdicts=verdicts)
    return LoopProof(seen.loop, claim, refuted, example, None, rollouts)
