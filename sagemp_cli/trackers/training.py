"""Training the tracker: back-propagation through closed-loop rollouts on the planner's own references.

``tracker_training=plain`` minimises exactly the paper's loss. ``tracker_training=certified`` adds the width of a
differentiable reach tube (forward affine arithmetic through the same loop), with the radius of the sets annealed from
small to full: the tracker learns to be verifiable, not only to track.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from sagemp_cli.config.ranges import Count, Positive, Whole
from sagemp_cli.errors import ConfigError
from sagemp_cli.learning.checkpoint import Resumable
from sagemp_cli.learning.fit import History, fit
from sagemp_cli.learning.schedule import Schedule
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.loop.controller import Controller
from sagemp_cli.problem import Problem
from sagemp_cli.progress import Progress
from sagemp_cli.sets import Box
from sagemp_cli.trackers.losses import LossWeights, rollout_loss
from sagemp_cli.trackers.tube_loss import TubeLoss


@dataclass(frozen=True)
class RolloutSampler:
    """Draws closed loops, starts and disturbances for training from the sets that will be verified.

    Half of the rollouts start in ``X_I`` at step 0; the others at a random later step from a smaller deviation,
    so that the whole reference is seen whatever the rollout length.

    Attributes:
        references: ``(R, K+1, n)``.
        start: ``X_I`` of one reference (its deviation from ``x_I`` is used for all).
        disturbance: ``W``.
        spread: extra deviation in every state, as a share of the limits' range, for the later starts.
    """

    references: Tensor
    start: Box
    disturbance: Box
    spread: Tensor

    def draw(self, count: int, length: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """References ``(count, K+1, n)`` from the drawn step, starts ``(count, n)``, disturbances ``(count, H, n)``.

        Args:
            count: rollouts.
            length: steps per rollout H.
            generator: source of all randomness.
        """
        total, horizon = self.references.shape[0], self.references.shape[1] - 1
        chosen = torch.randint(total, (count,), generator=generator)
        shift = torch.randint(max(1, horizon - length // 2), (count,), generator=generator)
        early = torch.arange(count) < (count + 1) // 2
        shift = torch.where(early, torch.zeros_like(shift), shift)
        index = (shift[:, None] + torch.arange(horizon + 1)).clamp(max=horizon)
        references = self.references[chosen[:, None], index]
        offset = self.start.sample(count, generator) - self.start.center
        unit = 2 * torch.rand(count, offset.shape[-1], dtype=torch.float64, generator=generator) - 1
        share = torch.rand(count, 1, dtype=torch.float64, generator=generator)
        late = 0.2 * share * offset + share * unit * self.spread
        starts = references[:, 0] + torch.where(early[:, None], offset, late)
        w = self.disturbance.sample(count * length, generator).unflatten(0, (count, length))
        # Every second rollout is disturbed by constant extremes: independent noise averages out and teaches little.
        sign = torch.randn(count, 1, w.shape[-1], dtype=torch.float64, generator=generator)
        held = torch.where(sign > 0, self.disturbance.upper, self.disturbance.lower)
        w = torch.where((torch.arange(count) % 2 == 0)[:, None, None], w, held.expand_as(w))
        return references, starts, w


@dataclass(frozen=True, kw_only=True)
class TrackerTrainingOptions(Schedule):
    """How a tracker learns.

    Attributes:
        batch: rollouts per step.
        rollout_steps: steps H per rollout (at most K).
        first_rollout_steps: steps per rollout at the beginning; they grow to ``rollout_steps`` by halfway. Rollouts of
            an untrained tracker on a robot that tumbles leave every bound, and their gradients say nothing.
        weights: of the loss's parts.
        tube: reachability-aware part, None for the paper's plain loss.
        tube_steps: further gradient steps with the reachability-aware part, from the plainly trained tracker.
    """

    learning_rate: Positive = 5e-3
    batch: Count = 64
    rollout_steps: Count = 40
    first_rollout_steps: Count | None = None
    weights: LossWeights | None = None
    tube: TubeLoss | None = None
    tube_steps: Whole = 150


def train_tracker(
    tracker: Controller,
    problem: Problem,
    options: TrackerTrainingOptions,
    *,
    references: Tensor,
    generator: torch.Generator,
    resumable: Resumable | None = None,
    progress: Progress | None = None,
) -> History:
    """Train ``tracker`` in place.

    Args:
        tracker: the policy.
        problem: what will be proved: its robot is differentiable.
        options: how long, on what and towards what.
        references: planner references ``(R, K+1, n)``.
        generator: source of all randomness.
        resumable, progress: see :func:`sagemp_cli.learning.fit.fit`.
    """
    dynamics, tube, rollout_steps = problem.dynamics, options.tube, options.rollout_steps
    horizon = references.shape[1] - 1
    if not 1 <= rollout_steps <= horizon:
        raise ConfigError(f"tracker_training.rollout_steps must lie in 1..{horizon}, found {rollout_steps}")
    first = rollout_steps if options.first_rollout_steps is None else options.first_rollout_steps
    if not 1 <= first <= rollout_steps:
        raise ConfigError(f"tracker_training.first_rollout_steps must lie in 1..{rollout_steps}, found {first}")
    loss_weights = options.weights or LossWeights()
    spread = 0.05 * (dynamics.state_upper - dynamics.state_lower)
    sampler = RolloutSampler(references, problem.start, problem.disturbance, spread)

    def tracking(module: nn.Module, length: int, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        assert isinstance(module, Controller)
        drawn, x, w = sampler.draw(options.batch, length, generator)
        states, controls = ClosedLoop(dynamics, module, drawn).rollout(x, w)
        return rollout_loss(dynamics, states[:, 1:], controls, drawn[:, 1 : length + 1], loss_weights)

    def plain(module: nn.Module, step: int, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        share = min(1.0, 2 * step / options.steps)
        return tracking(module, round(first * (rollout_steps / first) ** share), generator)

    def with_tube(module: nn.Module, step: int, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        assert isinstance(module, Controller) and tube is not None
        value, figures = tracking(module, rollout_steps, generator)
        share = step / max(1, options.tube_steps - 1)
        width, more = tube(module, problem, references=references, share=share, generator=generator)
        return value + width, figures | more

    about = {"generator": generator, "progress": progress}
    history = fit(tracker, plain, options, resumable=resumable, description="training the tracker", **about)
    if tube is None:
        return history
    if progress is not None:
        progress.say(
            f"the tube's width joins the loss, with sets that grow from {tube.shrink:.0%} of their size to all of it: "
            "so the loss rises now"
        )
    later, last = replace(options, steps=options.tube_steps), None if resumable is None else resumable.part("tube")
    more = fit(tracker, with_tube, later, resumable=last, description="training the tracker on its tubes", **about)
    return history.then(more)
