"""How safe plans are when executed: open loop and under the tracker, from everywhere in X_I, under disturbances.

The paper's surrogate for what certification brings: references are sampled from the planner and executed from X_I, and
the share that is safe is compared with the share that is certified.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.dynamics.inverse import Inverse, invert
from sagemp_cli.errors import UsageError
from sagemp_cli.execution.disturbances import Loop, random_disturbances, worst_case_disturbances
from sagemp_cli.execution.open_loop import OpenLoop
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.loop.controller import Controller
from sagemp_cli.problem import Problem
from sagemp_cli.progress import Progress, Silent
from sagemp_cli.verification.attack.refutation import SoundnessError

DISTURBANCES = ("none", "random", "worst case")
"""Under which references are tried: the middle of W, uniform in W, and corners of W that are chosen to do harm."""


@dataclass(frozen=True)
class Trials:
    """Rollouts of R references, M of each under each of the D kinds of :data:`DISTURBANCES`.

    Attributes:
        clearance: smallest signed distance to obstacles and workspace over the whole of all steps, ``(R, D, M)``;
            ``-inf`` where the rollout overflowed.
        reached: whether the state at step K was in the goal, ``(R, D, M)``.
        nearest: of the rollouts of each reference and kind that of the least clearance, ``(R, D, K+1, n)``.
    """

    clearance: Tensor
    reached: Tensor
    nearest: Tensor

    @property
    def safe(self) -> Tensor:
        """Whether a rollout was in the safe set all of the time, ``(R, D, M)``; it need not have reached the goal."""
        return self.clearance > 0


@dataclass(frozen=True)
class SafetyTrials:
    """References executed in two ways.

    Attributes:
        inverse: controls recovered from the references, and what they leave.
        open_loop: the recovered controls played back.
        closed_loop: the references tracked.
    """

    inverse: Inverse
    open_loop: Trials
    closed_loop: Trials


def try_references(
    references: Tensor,
    problem: Problem,
    *,
    tracker: Controller,
    rollouts: int,
    generator: torch.Generator,
    within_limits: bool = True,
    at_once: int = 16,
    progress: Progress | None = None,
) -> SafetyTrials:
    """Execute references open loop and under the tracker, from starts that are uniform in X_I.

    Starts and random disturbances are the same for both ways, worst-case ones are chosen to harm each way separately
    (:mod:`sagemp_cli.execution.disturbances`). The controls of a learned robot are recovered with the analytical model
    that it was learned from, and played back to the learned one.

    Args:
        references: ``(R, K+1, n)``.
        problem: robot, scene and sets, with X_I ``(n,)``.
        tracker: the policy; its controls are not clamped, as in the proof.
        rollouts: M, starts under each kind of disturbance.
        generator: randomness of starts and disturbances.
        within_limits: whether the recovered controls are clamped into the robot's limits.
        at_once: references that are rolled out together, which bounds the memory.
        progress: reports references.

    Raises:
        UsageError: a robot without an inverse, or no rollouts.
    """
    if rollouts < 1:
        raise UsageError(f"rollouts must be positive, found {rollouts}")
    dynamics, disturbance = problem.dynamics, problem.unknowns
    inverse = invert(dynamics.analytical, references, within_limits=within_limits)
    ways: tuple[Callable[[Tensor], Loop], ...] = (
        lambda r: OpenLoop(dynamics, inverse.controls[r]),
        lambda r: ClosedLoop(dynamics, tracker, references[r]),
    )
    found: tuple[list[Trials], ...] = ([], [])
    with (progress or Silent()).task("executing references", len(references)) as task:
        for some in torch.arange(len(references)).split(at_once):
            r = some.repeat_interleave(rollouts)
            x = problem.start.sample(len(r), generator)
            random = random_disturbances(disturbance, len(r), horizon=references.shape[1] - 1, generator=generator)
            for way, trials in zip(ways, found, strict=True):
                loop = way(r)
                harm = worst_case_disturbances(loop, x, disturbance=disturbance, generator=generator)
                with torch.no_grad():
                    tried = [(w, loop.rollout(x, w)) for w in (disturbance.center.expand_as(random), random, harm)]
                    paths = [dynamics.path(states, controls, w) for w, (states, controls) in tried]

                def apart(parts: Sequence[Tensor], count: int = len(some)) -> Tensor:
                    return torch.stack([part.unflatten(0, (count, rollouts)) for part in parts], 1)

                trials.append(_judged(apart([states for _, (states, _) in tried]), apart(paths), problem))
            task.advance(len(some))
    open_loop, closed_loop = (
        Trials(*(torch.cat([getattr(t, name) for t in trials]) for name in ("clearance", "reached", "nearest")))
        for trials in found
    )
    return SafetyTrials(inverse, open_loop, closed_loop)


def require_certified_safe(certified: Sequence[int], trials: Trials) -> None:
    """Raise if a rollout of a certified reference left the safe set or missed the goal.

    Raises:
        SoundnessError: then the proof or the simulation is wrong.
    """
    for r in certified:
        broken = torch.nonzero(~(trials.safe[r] & trials.reached[r])).tolist()
        if broken:
            kind, m = broken[0]
            raise SoundnessError(
                f"reference {r} is certified, but {len(broken)} of its {trials.safe[r].numel()} closed-loop rollouts "
                f"break the claim: rollout {m} under disturbances of kind '{DISTURBANCES[kind]}' has clearance "
                f"{float(trials.clearance[r, kind, m]):.3g} m and "
                f"{'reaches' if trials.reached[r, kind, m] else 'misses'} the goal"
            )


def _judged(states: Tensor, paths: Tensor, problem: Problem) -> Trials:
    """Of rollouts ``(R, D, M, K+1, n)`` and their paths between the samples, ``(R, D, M, P+1, n)``."""
    distance = problem.scene.signed_distance_along(paths[..., list(problem.dynamics.position)]).amin(-1)
    finite = torch.isfinite(states).flatten(-2).all(-1)
    clearance = torch.where(finite, distance, -torch.inf)
    worst = clearance.argmin(-1)[..., None, None, None].expand(-1, -1, 1, *states.shape[-2:])
    nearest = states.gather(2, worst).squeeze(2)
    return Trials(clearance, problem.scene.goal.contains(states[..., -1, :]), nearest)
