"""Training of any planner that learns from demonstrations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from sagemp_cli.config.ranges import Decay, Positive
from sagemp_cli.errors import NonFiniteError, UsageError
from sagemp_cli.learning.checkpoint import Resumable
from sagemp_cli.learning.fit import History, Loss, fit
from sagemp_cli.learning.schedule import Schedule
from sagemp_cli.planners.base import LearnedPlanner
from sagemp_cli.planners.figures import plan_figures
from sagemp_cli.problem import Problem
from sagemp_cli.progress import Progress

PLANS = 200
"""Plans of a validation at least: as many from each held-out start as that takes."""

LOSS_BATCHES = 4
"""Batches that the loss on the held-out demonstrations is averaged over."""


@dataclass(frozen=True, kw_only=True)
class PlannerTrainingOptions(Schedule):
    """How a planner learns from demonstrations.

    Attributes:
        loss: options of the planner's ``loss_type``.
    """

    learning_rate: Positive = 1e-2
    ema_decay: Decay | None = 0.995
    loss: Mapping[str, Any] | None = None


def train_planner(
    planner: LearnedPlanner,
    demonstrations: Tensor,
    *,
    held_out: Tensor,
    problem: Problem,
    options: PlannerTrainingOptions,
    generator: torch.Generator,
    resumable: Resumable | None = None,
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
        problem: robot and scene, for the goal and the share of safe plans.
        options: how long, and options of the loss.
        generator: source of all randomness.
        resumable, progress: see :func:`sagemp_cli.learning.fit.fit`.

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
    assert isinstance(planner, nn.Module)
    planner.prepare(demonstrations, goal=problem.scene.goal, generator=generator)

    def loss_on(data: Tensor) -> Loss:
        return planner.loss_type(planner, data, steps=options.steps, **(options.loss or {}))

    held_out_loss, position = loss_on(held_out), problem.dynamics.position
    shown = held_out.repeat_interleave(math.ceil(PLANS / len(held_out)), dim=0)
    # Every validation draws the same numbers, so that its curve shows the planner's course and not chance.
    seed = int(torch.randint(2**31, (), generator=generator))

    def validate(subject: Any) -> Mapping[str, float]:
        drawn = torch.Generator().manual_seed(seed)
        figures = plan_figures(subject, shown, scene=problem.scene, position=position, generator=drawn)
        losses = [float(held_out_loss(subject, options.steps - 1, drawn)[0]) for _ in range(LOSS_BATCHES)]
        return {"held-out loss": sum(losses) / len(losses)} | figures

    return fit(
        planner,
        loss_on(demonstrations),
        options,
        generator=generator,
        validate=validate,
        resumable=resumable,
        progress=progress,
        description="training the planner",
    )
