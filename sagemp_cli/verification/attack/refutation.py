"""Attacks on verdicts: a reference that is not certified may be refuted, and a certified one must withstand."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch

from sagemp_cli.config.ranges import Count, Whole
from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.loop.controller import Controller
from sagemp_cli.problem import Problem
from sagemp_cli.progress import Progress, Silent
from sagemp_cli.sets import Box
from sagemp_cli.sets.between import moment
from sagemp_cli.verification.attack.falsifier import Counterexample, falsify
from sagemp_cli.verification.verdict import Outcome, Verdict
from sagemp_cli.verification.verification import Verification

RATES = (2.0, 1.0, 0.5, 0.5, 0.25, 0.25, 0.1, 0.1)
SHORT_RATES = (2.0, 1.0, 0.5)


@dataclass(frozen=True)
class FalsifierOptions:
    """How hard is searched for counterexamples.

    Attributes:
        restarts: ascents per constraint of a reference that is not certified; 0 leaves them alone.
        safe_restarts: the same for certified ones.
        at_once: references in one batch, which bounds the memory.
    """

    restarts: Whole = 16
    safe_restarts: Whole = 2
    at_once: Count = 4


class SoundnessError(Exception):
    """A replayed rollout breaks what was certified: a bug of ours, never the user's fault."""


@dataclass(frozen=True)
class Refutation:
    """What the attacks found.

    Attributes:
        verification: the same with verdict UNSAFE for each refuted reference.
        counterexamples: index of the reference and the rollout, which rigorous arithmetic proves to break the claim.
        rollouts: simulated altogether.
        unproved: index of a reference that stays as it was and a rollout that breaks the claim in float64 only.
    """

    verification: Verification
    counterexamples: tuple[tuple[int, Counterexample], ...]
    rollouts: int
    unproved: tuple[tuple[int, Counterexample], ...] = ()


def attack(
    verification: Verification,
    problem: Problem,
    *,
    tracker: Controller,
    generator: torch.Generator,
    options: FalsifierOptions | None = None,
    progress: Progress | None = None,
) -> Refutation:
    """Search for counterexamples by gradient ascent on starts and disturbances.

    References that are not SAFE get ``options.restarts`` ascents per constraint, certified ones a short attack of
    ``options.safe_restarts`` as a guard against our own bugs. Finding nothing proves nothing.

    Args:
        verification: what to attack: the start boxes and W are its own.
        problem, tracker: what it speaks about.
        generator: draws where the ascents begin.
        options: how hard.
        progress: reports references.

    Raises:
        SoundnessError: a certified reference was refuted.
    """
    verdicts, found, unproved, rollouts = list(verification.verdicts), [], [], 0
    options, dynamics = options or FalsifierOptions(), problem.dynamics
    attacks = len(problem.scene.constraint_names) + 1
    with (progress or Silent()).task("searching for counterexamples", len(verdicts)) as task:
        for safe, starts, rates in ((False, options.restarts, RATES), (True, options.safe_restarts, SHORT_RATES)):
            targets = [r for r, v in enumerate(verification.verdicts) if (v.outcome is Outcome.SAFE) is safe]
            for begin in range(0, len(targets), options.at_once):
                some = targets[begin : begin + options.at_once]
                if starts > 0:
                    boxes = Box(verification.start.lower[some], verification.start.upper[some])
                    examples = falsify(
                        ClosedLoop(dynamics, tracker, verification.references[some]),
                        dataclasses.replace(problem, start=boxes, disturbance=verification.disturbance),
                        generator=generator,
                        restarts=starts,
                        rates=rates,
                    )
                    rollouts += starts * attacks * (len(rates) + 1) * len(some)
                    for r, example in zip(some, examples, strict=True):
                        if example is None or (safe and not example.proved):
                            continue
                        if not example.proved:
                            unproved.append((r, example))
                            continue
                        name = decided(example, dynamics)
                        if safe:
                            raise SoundnessError(
                                f"reference {r} was certified by '{verification.propagator}', but a replayed rollout "
                                f"breaks '{name}' at {moment(example.step, example.fraction)} by {example.depth:.3g}; "
                                "please report this"
                            )
                        found.append((r, example))
                        verdicts[r] = Verdict(Outcome.UNSAFE, example.step, name, example.fraction)
                task.advance(len(some))
    refuted = dataclasses.replace(verification, verdicts=tuple(verdicts))
    return Refutation(refuted, tuple(found), rollouts, tuple(unproved))


def decided(example: Counterexample, dynamics: Dynamics) -> str:
    """What a counterexample breaks, in words: an obstacle, the workspace, or ``goal <state>``."""
    return f"goal {dynamics.state_names[example.state]}" if example.kind == "goal" else example.name
