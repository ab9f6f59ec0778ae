"""Training of any planner that learns from demonstrations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sagemp_cli.config.ranges import Count, Decay, Positive
from sagemp_cli.errors import NonFiniteError, UsageError
from sagemp_cli.learning.fit import History, fit
from sagemp_cli.planners.base import LearnedPlanner
from sagemp_cli.planners.figures import plan_figures
from sagemp_cli.progress import Progress
from sagemp_cli.scenes.scene import Scene

PLANS = 200
"""Plans of a validation at least: as many from each held-out start as that takes."""

LOSS_BATCHES = 4
"""Batches that the loss on the held-out demonstrations is averaged over."""


def train_planner(
    planner: LearnedPlanner,
    demonstrations: Tensor,
    *,
    held_out: Tensor,
    scene: Scene,
    position: tuple[int, ...],
    generator: torch.Generator,
    steps: Count,
    learning_rate: Positive = 1e-2,
    ema_decay: Decay | None = 0.995,
    loss: Mapping[str, Any] | None = None,
    checkpoint: Path | None = None,
    identity: str = "",
    progress: Progress | None = None,
) -> History:
    """Train ``planner`` in place; validate it on the held-out demonstrations.

    The validation curve is :func:`~sagemp_cli.planners.figures.plan_figures` and ``held-out loss``, the planner's own
    loss as in the last update. The result depends on the arguments and the generator's state alone, not on the
    planner's weights before.

    Args:
        planner: what learns.
        demonstrations: ``(D, K+1, n)``, float64.
        held_out: demonstrations from other starts, ``(V, K+1, n)``.
        scene: for the share of safe plans.
        position: indices of the states that are the position.
        generator: source of all randomness.
        steps: number of updates.
        learning_rate: see :func:`sagemp_cli.learning.fit.fit`.
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
    planner.prepare(demonstrations, goal=scene.goal, generator=generator)
    options = {"steps": steps, **(loss or {})}
    held_out_loss = planner.loss_type(planner, held_out, **options)
    shown = held_out.repeat_interleave(math.ceil(PLANS / len(held_out)), dim=0)
    # Every validation draws the same numbers, so that its curve shows the planner's course and not chance.
    seed = int(torch.randint(2**31, (), generator=generator))

    def validate(subject: LearnedPlanner) -> Mapping[str, float]:
        drawn = torch.Generator().manual_seed(seed)
        figures = plan_figures(subject, shown, scene=scene, position=position, generator=drawn)
        losses = [float(held_out_loss(subject, steps - 1, drawn)[0]) for _ in range(LOSS_BATCHES)]
        return {"held-out loss": sum(losses) / len(losses)} | figures

    return fit(
        planner,
        planner.loss_type(planner, demonstrations, **options),
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
