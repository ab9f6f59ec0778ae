"""Training of any learned planner on demonstrations, and the figures that say how good its plans are."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sagemp_cli.errors import NonFiniteError, UsageError
from sagemp_cli.planners.base import LearnedPlanner, Planner
from sagemp_cli.progress import Progress
from sagemp_cli.scenes.scene import Scene
from sagemp_cli.training import History, fit


def train_planner(
    planner: LearnedPlanner,
    demonstrations: Tensor,
    *,
    held_out: Tensor,
    scene: Scene,
    position: tuple[int, ...],
    generator: torch.Generator,
    steps: int,
    learning_rate: float = 1e-2,
    ema_decay: float | None = 0.995,
    loss: Mapping[str, Any] | None = None,
    checkpoint: Path | None = None,
    identity: str = "",
    progress: Progress | None = None,
) -> History:
    """Train ``planner`` in place; the validation curve is :func:`plan_figures` on the held-out demonstrations.

    The result depends on the arguments and the generator's state alone, not on the planner's weights before.

    Args:
        planner: what learns.
        demonstrations: ``(D, K+1, n)``, float64.
        held_out: demonstrations from other starts, ``(V, K+1, n)``.
        scene: for the share of safe plans.
        position: indices of the states that are the position.
        generator: source of all randomness.
        steps: number of updates.
        learning_rate: see :func:`sagemp_cli.training.fit`.
        ema_decay: see there.
        loss: options of the planner's ``loss_type``.
        checkpoint: see there.
        identity: see there.
        progress: where the course is shown.

    Raises:
        UsageError: demonstrations that do not fit the planner.
        NonFiniteError: demonstrations with NaN or infinity, or a loss that became so.
    """
    wanted = (planner.horizon + 1, planner.state_dim)
    for name, data in (("demonstrations", demonstrations), ("held-out demonstrations", held_out)):
        if data.dim() != 3 or len(data) == 0 or tuple(data.shape[1:]) != wanted:
            raise UsageError(f"{name} must have shape (count, {wanted[0]}, {wanted[1]}), found {tuple(data.shape)}")
        if not bool(torch.isfinite(data).all()):
            raise NonFiniteError(f"{name} contain NaN or infinity")
    planner.prepare(demonstrations, generator=generator)
    # Every validation draws the same numbers, so that its curve shows the planner's course and not chance.
    seed = int(torch.randint(2**31, (), generator=generator))

    def validate(subject: Planner) -> Mapping[str, float]:
        drawn = torch.Generator().manual_seed(seed)
        return plan_figures(subject, held_out, scene=scene, position=position, generator=drawn)

    return fit(
        planner,
        planner.loss_type(planner, demonstrations, steps=steps, **(loss or {})),
        steps=steps,
        learning_rate=learning_rate,
        ema_decay=ema_decay,
        generator=generator,
        validate=validate,
        checkpoint=checkpoint,
        identity=identity,
        progress=progress,
        description="training the planner",
    )


def plan_figures(
    planner: Planner,
    demonstrations: Tensor,
    *,
    scene: Scene,
    position: tuple[int, ...],
    generator: torch.Generator,
) -> dict[str, float]:
    """How good one plan from every demonstrated start is, as a plan: nothing tracks it.

    Returns:
        ``position error``: root mean square distance to the demonstration over steps and demonstrations, metres (a
        plan that takes another side than the demonstration counts as far away); ``median position error``: median
        over demonstrations of that over steps; ``collision-free``: share of plans that keep clear at every step;
        ``in goal``: share that end in the goal box; ``goal error``: mean distance of the last position to the
        goal's centre over dimensions in which the goal is bounded, metres.
    """
    plans = planner.sample(
        demonstrations[:, 0], scene.goal, scene=scene, count=len(demonstrations), generator=generator
    )
    where = list(position)
    square = (plans - demonstrations)[..., where].square().sum(-1).mean(-1)
    center = scene.goal.center[where]
    beside = (plans[:, -1, where] - center)[:, torch.isfinite(center)]
    return {
        "position error": float(square.mean().sqrt()),
        "median position error": float(square.sqrt().median()),
        "collision-free": float((scene.signed_distance(plans[..., where]) > 0).all(-1).double().mean()),
        "in goal": float(scene.goal.contains(plans[:, -1]).double().mean()),
        "goal error": float(torch.linalg.vector_norm(beside, dim=-1).mean()),
    }
