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

from sagemp_cli.errors import UsageError
from sagemp_cli.scenes.scene import Scene
from sagemp_cli.sets import PARTS, Between, Box, Bulge, Tube, over_steps
from sagemp_cli.sets.between import moment


class Outcome(StrEnum):
    """What is known about one reference."""

    SAFE = "SAFE"
    """Proved: the tube keeps clear over the whole of every step and lies in the goal at step K."""
    MAY_COLLIDE = "MAY_COLLIDE"
    """The tube touches an obstacle or the workspace's boundary."""
    MISSES_GOAL = "MISSES_GOAL"
    """The tube keeps clear, but at step K it is not inside the goal."""
    MAY_VIOLATE = "MAY_VIOLATE"
    """In continuous time: a requirement is not proved of the flow."""
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
        fraction: of that step, in [0, 1): nothing happens before it is over, and from there on it is not proved (or
            refuted).
        constraint: obstacle, ``workspace``, ``goal <state>``, or the state that overflowed; empty if SAFE.
    """

    outcome: Outcome
    step: int = -1
    constraint: str = ""
    fraction: float = 0.0

    def described(self, dt: float | None = None) -> str:
        """In words, with the time in seconds if that between two samples is known."""
        if self.outcome is Outcome.SAFE:
            return str(self.outcome)
        return f"{self.outcome} at {moment(self.step, self.fraction, dt)} ({self.constraint})"

    def __str__(self) -> str:
        return self.described()


@dataclass(frozen=True)
class Assessment:
    """What tubes prove, per reference.

    Attributes:
        verdicts: one each.
        clearance: ``(R, constraints)``, certified lower bound on the distance to each constraint over all of the time
            and all cells, ``-inf`` where the tube overflowed.
        goal_margin: ``(R, n)``, distance of the tube at K from the goal's faces, negative outside, ``inf`` where
            the goal has no face.
    """

    verdicts: tuple[Verdict, ...]
    clearance: Tensor
    goal_margin: Tensor


def assess(
    tube: Tube,
    scene: Scene,
    *,
    cell_reference: Tensor,
    position: Sequence[int],
    state_names: Sequence[str],
    between: Between = Between.SEGMENTS,
    lines: tuple[Tube, Bulge] | None = None,
) -> Assessment:
    """Judge the tubes ``(C, K+1, n)`` of the cells of R references; those of one together cover its start box.

    SAFE needs every cell's tube to be finite, clear of all constraints over the whole of every step, from k = 0 to K,
    and inside the goal at K. Each step is checked in :data:`~sagemp_cli.sets.between.PARTS` parts. The paper asks for
    the samples k = 1..K only; a start box in collision is not called safe here. A tube that touches an obstacle is not
    clear of it. Of several violations the earliest part of a step is named by its begin, and there the constraint that
    is violated most; an overflow anywhere makes the whole tube UNBOUNDED.

    Args:
        tube: bounds; NaN counts as an overflow.
        scene: constraints and goal.
        cell_reference: which reference each cell belongs to, ``(C,)``, each of 0..R-1 at least once.
        position: indices of the states that are the position.
        state_names: names for messages, n of them.
        between: with ``SAMPLES`` the states at the samples have to keep clear and nothing else.
        lines: boxes at S equal parts of every step, ``(C, K S + 1, n)``, and what leaves the straight lines between
            them, ``(C, K S, n)``, where that is known better than by the samples; see :class:`.Flow`.

    Raises:
        UsageError: a reference without cells, of which nothing is proved.
    """
    count = int(cell_reference.max()) + 1 if len(cell_reference) else 0
    if len(cell_reference) != len(tube.lower) or not torch.equal(cell_reference.unique(), torch.arange(count)):
        raise UsageError(f"every one of {count} references needs cells, and every cell a reference")
    found = _measure(tube, scene, position, between, lines)
    parts = 1 if between is Between.SAMPLES else PARTS
    parts = parts if lines is None else parts * (lines[0].horizon // tube.horizon)
    clearances = _least(found.clearances, cell_reference, count)  # (R, parts of all steps, constraints)
    goal_margin = _least(found.goal_margin, cell_reference, count)
    reaches = _least(found.reaches, cell_reference, count)
    finite = _least(found.finite, cell_reference, count)  # (R, K+1, n)

    verdicts = []
    for r in range(count):
        if not bool(finite[r].all()):
            step = _first(~finite[r].all(-1))
            verdicts.append(Verdict(Outcome.UNBOUNDED, step, state_names[_first(~finite[r, step])]))
        elif not bool((clearances[r] > 0).all()):
            place = _first(~(clearances[r] > 0).all(-1))
            name = scene.constraint_names[int(clearances[r, place].argmin())]
            verdicts.append(Verdict(Outcome.MAY_COLLIDE, place // parts, name, place % parts / parts))
        elif not bool(reaches[r]):
            name = state_names[int(goal_margin[r].argmin())]
            verdicts.append(Verdict(Outcome.MISSES_GOAL, tube.horizon, f"goal {name}"))
        else:
            verdicts.append(Verdict(Outcome.SAFE))
    return Assessment(tuple(verdicts), clearances.amin(1), goal_margin)


def shortfall(
    tube: Tube,
    scene: Scene,
    *,
    position: Sequence[int],
    between: Between = Between.SEGMENTS,
    lines: tuple[Tube, Bulge] | None = None,
) -> tuple[Tensor, Tensor]:
    """How far each of the tubes ``(C, K+1, n)`` is from being SAFE by itself.

    Returns:
        Whether it is SAFE, as in :func:`assess`, ``(C,)``; and a measure of what is missing, 0 if nothing is, ``(C,)``:
        the sum over all constraints, faces of the goal and steps (of each the mean over its parts) of
        ``log(1 + depth)``. It guides, it proves nothing.
    """
    found = _measure(tube, scene, position, between, lines)
    safe = found.finite.flatten(1).all(1) & (found.clearances > 0).flatten(1).all(1) & found.reaches
    depth = torch.log1p((-found.clearances).clamp(min=0.0, max=_HUGE)).mean(1).sum(1) * (tube.horizon + 1)
    short = torch.log1p((-found.goal_margin).clamp(min=0.0, max=_HUGE)).sum(1)
    return safe, torch.where(safe, 0.0, depth + tube.horizon * short)


_HUGE = 1e300


@dataclass(frozen=True)
class _Measures:
    """Of each cell: bounds that are finite, clearances of all parts of all steps in turn (or at the samples), goal
    margins, and whether it ends in the goal."""

    finite: Tensor
    clearances: Tensor
    goal_margin: Tensor
    reaches: Tensor


def _measure(
    tube: Tube, scene: Scene, position: Sequence[int], between: Between, lines: tuple[Tube, Bulge] | None
) -> _Measures:
    if between is Between.CONTINUOUS and lines is None:
        raise UsageError("a claim about all times needs to know what solutions do between the samples")
    finite = torch.isfinite(tube.lower) & torch.isfinite(tube.upper)
    if lines is not None:  # a step over which nothing is known ends unbounded
        fine, bulge = lines
        known = bulge.known & torch.isfinite(fine.lower[..., 1:, :]) & torch.isfinite(fine.upper[..., 1:, :])
        known = known.unflatten(-2, (tube.horizon, -1)).all(-2)
        finite = torch.cat([finite[..., :1, :], finite[..., 1:, :] & known], dim=-2)
    everywhere = torch.full_like(tube.lower, torch.inf)
    lower, upper = torch.where(finite, tube.lower, -everywhere), torch.where(finite, tube.upper, everywhere)
    over = positions_over_time(Tube(lower, upper), position, between, lines)
    goal_margin = torch.minimum(
        _margin(lower[..., -1, :], scene.goal.lower), _margin(-upper[..., -1, :], -scene.goal.upper)
    )
    return _Measures(
        finite,
        scene.clearances(over),
        goal_margin,
        scene.goal.contains(Box(lower[..., -1, :], upper[..., -1, :])),
    )


def positions_over_time(
    tube: Tube, position: Sequence[int], between: Between, lines: tuple[Tube, Bulge] | None = None
) -> Box:
    """Boxes ``(C, P, d)`` of the positions over all parts of all steps in turn, or at the samples."""
    index = list(position)
    places = Tube(tube.lower[..., index], tube.upper[..., index])
    if between is Between.SAMPLES:
        return Box(places.lower, places.upper)
    bends = None
    if lines is not None:
        fine, bulge = lines
        places = Tube(fine.lower[..., index], fine.upper[..., index])
        bends = Bulge(*(b[..., index] for b in (bulge.curve, bulge.swing, bulge.rest)))
    parts = over_steps(places, bends)
    return Box(parts.lower.flatten(-3, -2), parts.upper.flatten(-3, -2))


def _least(values: Tensor, owner: Tensor, count: int) -> Tensor:
    """The least value (of flags: whether all hold) over the cells of each reference, ``(R, ...)``."""
    numbers = values.double() if values.dtype == torch.bool else values
    index = owner.reshape(-1, *[1] * (values.dim() - 1)).expand(values.shape)
    least = torch.full((count, *values.shape[1:]), torch.inf, dtype=numbers.dtype)
    return least.scatter_reduce(0, index, numbers, "amin").to(values.dtype)


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
