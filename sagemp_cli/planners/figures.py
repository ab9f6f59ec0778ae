"""The figures of a model card: how good plans are as plans, before anything tracks them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import torch
from torch import Tensor

from sagemp_cli.planners.base import Planner, Proposer
from sagemp_cli.scenes.scene import Scene
from sagemp_cli.scenes.sides import side_label, sides_of


def plan_figures(
    planner: Planner,
    demonstrations: Tensor,
    *,
    scene: Scene,
    position: tuple[int, ...],
    generator: torch.Generator,
) -> dict[str, float]:
    """How good one plan from every demonstrated start is, on its own and beside the demonstrations.

    Returns:
        Those of :func:`open_loop_figures`, with the shares of the demonstrated sides, and ``position error``: root
        mean square distance to the demonstration over steps and demonstrations, metres (a plan that takes another
        side than the demonstration counts as far away); ``median position error``: median over demonstrations of
        that over steps; ``roughness``: see :func:`roughness`.
    """
    plans, start_error = _plans(planner, demonstrations[:, 0], scene, position, generator)
    where = list(position)
    square = (plans - demonstrations)[..., where].square().sum(-1).mean(-1)
    labels = sorted(side_shares(demonstrations, scene=scene, position=position))
    return {
        "position error": float(square.mean().sqrt()),
        "median position error": float(square.sqrt().median()),
        "roughness": roughness(plans, demonstrations),
    } | _open_loop(plans, start_error, scene, position, labels)


def open_loop_figures(
    planner: Planner,
    starts: Tensor,
    *,
    scene: Scene,
    position: tuple[int, ...],
    generator: torch.Generator,
) -> dict[str, float]:
    """How good one plan from each of ``starts (count, n)`` is, where there is nothing to compare it with.

    Returns:
        ``collision-free``: share of plans that keep clear at every step; ``in goal``: share that end in the goal box;
        ``goal error``: mean distance of the last position to the goal's centre over dimensions in which the goal is
        bounded, metres; ``start error``: mean distance of the first position to the start, metres, before a planner
        that generates the start too (:class:`~sagemp_cli.planners.base.Proposer`) has moved its plan there;
        ``share LR``: share of plans that pass the first obstacle on the left and the second on the right, and so
        on for every combination of sides that occurs.
    """
    plans, start_error = _plans(planner, starts, scene, position, generator)
    labels = sorted(side_shares(plans, scene=scene, position=position))
    return _open_loop(plans, start_error, scene, position, labels)


def side_shares(trajectories: Tensor, *, scene: Scene, position: tuple[int, ...]) -> dict[str, float]:
    """Shares of trajectories ``(count, K+1, n)`` on each combination of sides that occurs; none without obstacles."""
    if not scene.obstacles:
        return {}
    paths = trajectories[..., list(position)].numpy()
    found = Counter(side_label(sides_of(path, scene.obstacles), len(position)) for path in paths)
    return {label: count / len(paths) for label, count in found.items()}


def roughness(plans: Tensor, demonstrations: Tensor) -> float:
    """Root mean square second difference of plans over that of demonstrations, in the state where it is largest.

    A tracker has to follow second differences. States in which demonstrations have none (their second differences
    are rounding errors) are left out.
    """
    rough, smooth = (x.diff(n=2, dim=1).square().mean((0, 1)).sqrt() for x in (plans, demonstrations))
    moving = smooth > 1e-9 * (1 + demonstrations.abs().amax((0, 1)))
    return float((rough / smooth)[moving].max()) if bool(moving.any()) else 1.0


def _plans(
    planner: Planner, starts: Tensor, scene: Scene, position: tuple[int, ...], generator: torch.Generator
) -> tuple[Tensor, float]:
    """One plan from each start, and the start error before it was made good."""
    arguments = {"scene": scene, "count": len(starts), "generator": generator}
    if isinstance(planner, Proposer):
        proposed = planner.propose(starts, scene.goal, **arguments)
        plans = planner.settle(proposed, starts)
    else:
        plans = proposed = planner.sample(starts, scene.goal, **arguments)
    missed = (proposed[:, 0] - starts)[:, list(position)]
    return plans, float(torch.linalg.vector_norm(missed, dim=-1).mean())


def _open_loop(
    plans: Tensor, start_error: float, scene: Scene, position: tuple[int, ...], labels: Sequence[str]
) -> dict[str, float]:
    where = list(position)
    center = scene.goal.center[where]
    beside = (plans[:, -1, where] - center)[:, torch.isfinite(center)]
    shares = side_shares(plans, scene=scene, position=position)
    return {
        "collision-free": float((scene.signed_distance_along(plans[..., where]) > 0).all(-1).double().mean()),
        "in goal": float(scene.goal.contains(plans[:, -1]).double().mean()),
        "goal error": float(torch.linalg.vector_norm(beside, dim=-1).mean()),
        "start error": start_error,
    } | {f"share {label}": shares.get(label, 0.0) for label in labels}
