"""Verdicts: what a tube proves about a scene, as values.

One-sided: SAFE follows from bounds that were rounded outwards and holds for every rollout inside the tube; every
other outcome only says that this tube does not prove it, except UNSAFE, which a replayed counterexample proves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import torch
from torch import Tensor

from sagemp_cli.scenes.scene import Scene
from sagemp_cli.sets import Box, Tube


class Outcome(StrEnum):
    """What is known about one reference."""

    SAFE = "SAFE"
    """Proved: the tube keeps clear at every step and lies in the goal at step K."""
    MAY_COLLIDE = "MAY_COLLIDE"
    """The tube touches an obstacle or the workspace's boundary."""
    MISSES_GOAL = "MISSES_GOAL"
    """The tube keeps clear, but at step K it is not inside the goal."""
    UNBOUNDED = "UNBOUNDED"
    """The tube overflowed; nothing is proved from there on."""
    UNSAFE = "UNSAFE"
    """Refuted: a replayed counterexample violates the claim."""


class Answer(StrEnum):
    """Whether all references are certified, in the words of the verification competitions."""

    VERIFIED = "VERIFIED"
    FALSIFIED = "FALSIFIED"
    UNKNOWN = "UNKNOWN"


@dataclass(frozen=True)
class Verdict:
    """An outcome and what decided it.

    Attributes:
        outcome: see :class:`Outcome`.
        step: the earliest step that decided; -1 if SAFE.
        constraint: obstacle, ``workspace``, ``goal <state>``, or the state that overflowed; empty if SAFE.
    """

    outcome: Outcome
    step: int = -1
    constraint: str = ""

    def __str__(self) -> str:
        if self.outcome is Outcome.SAFE:
            return str(self.outcome)
        return f"{self.outcome} at step {self.step} ({self.constraint})"


@dataclass(frozen=True)
class Assessment:
    """What tubes prove, per reference.

    Attributes:
        verdicts: one each.
        clearance: ``(R, constraints)``, certified lower bound on the distance to each constraint over all steps
            and cells, ``-inf`` where the tube overflowed.
        goal_margin: ``(R, n)``, distance of the tube at K from the goal's faces, negative outside, ``inf`` where
            the goal has no face.
    """

    verdicts: tuple[Verdict, ...]
    clearance: Tensor
    goal_margin: Tensor


def assess(tube: Tube, scene: Scene, *, position: Sequence[int], state_names: Sequence[str]) -> Assessment:
    """Judge the tubes ``(R, C, K+1, n)`` of R references, each with C cells that together cover its start box.

    SAFE needs every cell's tube to be finite, clear of all constraints at every step k = 0..K and inside the goal at
    K. The paper asks for k = 1..K only; a start box in collision is not called safe here. A tube that touches an
    obstacle is not clear of it. Of several violations the earliest step is named, and there the constraint that
    is violated most; an overflow anywhere makes the whole tube UNBOUNDED.

    Args:
        tube: bounds; NaN counts as an overflow.
        scene: constraints and goal.
        position: indices of the states that are the position.
        state_names: names for messages, n of them.
    """
    finite = torch.isfinite(tube.lower) & torch.isfinite(tube.upper)
    everywhere = torch.full_like(tube.lower, torch.inf)
    lower, upper = torch.where(finite, tube.lower, -everywhere), torch.where(finite, tube.upper, everywhere)

    index = list(position)
    clearances = scene.clearances(Box(lower[..., index], upper[..., index])).amin(1)  # (R, K+1, constraints)
    goal_margin = torch.minimum(
        _margin(lower[..., -1, :], scene.goal.lower), _margin(-upper[..., -1, :], -scene.goal.upper)
    ).amin(1)
    reaches = scene.goal.contains(Box(lower[..., -1, :], upper[..., -1, :])).all(1)
    overflow = ~finite.all(1)  # (R, K+1, n)

    verdicts = []
    for r in range(tube.lower.shape[0]):
        if bool(overflow[r].any()):
            step = _first(overflow[r].any(-1))
            verdicts.append(Verdict(Outcome.UNBOUNDED, step, state_names[_first(overflow[r, step])]))
        elif not bool((clearances[r] > 0).all()):
            step = _first(~(clearances[r] > 0).all(-1))
            name = scene.constraint_names[int(clearances[r, step].argmin())]
            verdicts.append(Verdict(Outcome.MAY_COLLIDE, step, name))
        elif not bool(reaches[r]):
            name = state_names[int(goal_margin[r].argmin())]
            verdicts.append(Verdict(Outcome.MISSES_GOAL, tube.horizon, f"goal {name}"))
        else:
            verdicts.append(Verdict(Outcome.SAFE))
    return Assessment(tuple(verdicts), clearances.amin(1), goal_margin)


def answer_of(verdicts: Sequence[Verdict]) -> Answer:
    """VERIFIED if all are SAFE, FALSIFIED if one is UNSAFE, else UNKNOWN (also if there are none)."""
    if any(v.outcome is Outcome.UNSAFE for v in verdicts):
        return Answer.FALSIFIED
    return Answer.VERIFIED if verdicts and all(v.outcome is Outcome.SAFE for v in verdicts) else Answer.UNKNOWN


def _margin(inner: Tensor, outer: Tensor) -> Tensor:
    """``inner - outer``, infinite where there is no face at ``outer = -inf`` (also if ``inner`` is -inf)."""
    return torch.where(torch.isinf(outer) & (outer < 0), torch.full_like(inner, torch.inf), inner - outer)


def _first(flags: Tensor) -> int:
    return int(torch.nonzero(flags)[0, 0])
