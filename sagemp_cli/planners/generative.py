"""What flow matching and diffusion share: knots of splines, conditions, drawing of batches, sampling of plans."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from sagemp_cli.config.ranges import Count, Whole
from sagemp_cli.errors import ConfigError, NonFiniteError
from sagemp_cli.planners.base import starts_of
from sagemp_cli.planners.normalizer import Normalizer
from sagemp_cli.planners.spline import Spline
from sagemp_cli.planners.temporal_network import TemporalNetwork
from sagemp_cli.scenes.scene import Scene
from sagemp_cli.sets import Box

FADE = 0.2
"""Share of the horizon over which a plan's error at the start is faded out."""


@dataclass(frozen=True)
class Conditions:
    """What plans are asked to begin and end with, as the network sees it; float32.

    Attributes:
        vector: features of start and goal, ``(B, 2n)``.
        line: knots of the straight way from start to goal in normalised states, ``(B, M, n)``.
    """

    vector: Tensor
    line: Tensor

    def __getitem__(self, which: Tensor) -> Conditions:
        return Conditions(self.vector[which], self.line[which])


class GenerativePlanner(nn.Module, ABC):
    """Plans as samples of a learned distribution over splines, given start and goal.

    A plan is generated as normalised knots of cubic splines (:class:`~sagemp_cli.planners.spline.Spline`), so it is
    smooth whatever the network does. Start and goal reach the network twice: as a vector in every block, and as
    the straight way between them beside the noisy knots.

    The goal that a demonstration is trained with is the centre of a goal box that contains its end: drawn uniformly
    among these, since a demonstration is one for each of them. States in which the goal is unbounded are no condition.

    The network proposes the start too (``propose``); its error there shows how well it listens. :meth:`settle` then
    moves the plan onto the start: wholly at row 0 and smoothly less over the first fifth of the horizon, so no jump
    is left. The network computes in float32, whose rounding is no concern of the proof.

    Args:
        state_dim: number of states n.
        horizon: number of steps K.
        knots: knots M of a plan.
        width: channels of the network, see :class:`~sagemp_cli.planners.temporal_network.TemporalNetwork`.
        kernel: knots that a convolution sees, odd.
        frequencies: features of the generative time.
    """

    learns_from: ClassVar[str] = "demonstrations"

    goal_radius: Tensor
    goal_bounded: Tensor
    usual_end: Tensor

    def __init__(
        self,
        *,
        state_dim: Count,
        horizon: Count,
        knots: Count = 20,
        width: Count = 64,
        kernel: Count = 3,
        frequencies: Whole = 8,
    ) -> None:
        super().__init__()
        if state_dim < 1 or horizon < 1:
            raise ConfigError(f"planner: state_dim and horizon must be positive, found {state_dim} and {horizon}")
        self.state_dim, self.horizon, self.knots = int(state_dim), int(horizon), int(knots)
        self.width, self.kernel, self.frequencies = int(width), int(kernel), int(frequencies)
        self.normalizer, self.start_normalizer = Normalizer(state_dim), Normalizer(state_dim)
        self.register_buffer("goal_radius", torch.zeros(state_dim, dtype=torch.float64))
        self.register_buffer("goal_bounded", torch.ones(state_dim, dtype=torch.bool))
        self.register_buffer("usual_end", torch.zeros(state_dim, dtype=torch.float64))
        self.spline = Spline(horizon=horizon, knots=knots)
        self.network = TemporalNetwork(
            2 * state_dim, state_dim, condition=2 * state_dim, width=width, kernel=kernel, frequencies=frequencies
        )

    @property
    def arguments(self) -> dict[str, Any]:
        """Plain keyword arguments that rebuild this planner; its weights are in ``state_dict()``."""
        return {
            "state_dim": self.state_dim,
            "horizon": self.horizon,
            "knots": self.knots,
            "width": self.width,
            "kernel": self.kernel,
            "frequencies": self.frequencies,
        }

    def prepare(self, demonstrations: Tensor, *, goal: Box, generator: torch.Generator) -> None:
        """Fit the normalisers to demonstrations ``(D, K+1, n)``, note the goal box's size and draw initial weights."""
        self.normalizer.fit(demonstrations)
        self.start_normalizer.fit(demonstrations[:, 0])
        self.usual_end.copy_(demonstrations[:, -1].mean(0))
        radius = 0.5 * (goal.upper - goal.lower)
        self.goal_bounded.copy_(torch.isfinite(radius))
        self.goal_radius.copy_(torch.where(self.goal_bounded, radius, torch.zeros_like(radius)))
        self.network.reset(generator)

    def encode(self, rows: Tensor) -> Tensor:
        """Normalised knots ``(..., M, n)``, float32, of trajectories ``(..., K+1, n)``."""
        return self.spline.knots_of(self.normalizer.normalize(rows)).float()

    def decode(self, knots: Tensor) -> Tensor:
        """Trajectories ``(..., K+1, n)``, float64, of normalised knots ``(..., M, n)``."""
        return self.normalizer.denormalize(self.spline.rows_of(knots))

    def conditions(self, starts: Tensor, goals: Tensor) -> Conditions:
        """From starts ``(B, n)`` and centres of goals ``(B, n)``; unbounded states of a goal are not looked at."""
        begin, end = self.normalizer.normalize(starts), self.normalizer.normalize(goals)
        end = torch.where(self.goal_bounded, end, begin)
        share = torch.linspace(0, 1, self.knots, dtype=torch.float64)[:, None]
        line = begin[:, None] + share * (end - begin)[:, None]
        features = torch.where(self.goal_bounded, end, torch.zeros_like(end))
        vector = torch.cat([self.start_normalizer.normalize(starts), features], dim=-1)
        return Conditions(vector.float(), line.float())

    def answer(self, z: Tensor, t: Tensor, conditions: Conditions) -> Tensor:
        """What the network says about knots ``z (B, M, n)`` at generative times ``t (B,)`` in [0, 1]."""
        return self.network(torch.cat([z, conditions.line], dim=-1), t, conditions.vector)

    @abstractmethod
    def generate(self, noise: Tensor, conditions: Conditions, *, generator: torch.Generator) -> Tensor:
        """Knots ``(B, M, n)`` from standard normal ``noise`` of the same shape."""

    @torch.no_grad()
    def propose(self, start: Tensor, goal: Box, *, scene: Scene, count: int, generator: torch.Generator) -> Tensor:
        """Plans ``(count, K+1, n)`` as the network has them, which begin near the start and not at it.

        ``scene`` is not looked at: obstacles are known from the demonstrations alone.

        Raises:
            NonFiniteError: the generation overflowed.
        """
        starts = starts_of(start, count=count, state_dim=self.state_dim)
        center = goal.center
        center = torch.where(torch.isfinite(center), center, self.usual_end)
        noise = torch.randn(count, self.knots, self.state_dim, generator=generator)
        conditions = self.conditions(starts, center.expand_as(starts))
        plans = self.decode(self.generate(noise, conditions, generator=generator))
        if not bool(torch.isfinite(plans).all()):
            raise NonFiniteError("planner: a sampled reference contains NaN or infinity; train the planner longer")
        return plans

    def settle(self, plans: Tensor, start: Tensor) -> Tensor:
        """Plans ``(count, K+1, n)`` moved onto their starts ``(n,)`` or ``(count, n)``; row 0 is the start exactly.

        Row k moves by ``(x_0 - p_0) (1 - s(k / (FADE K)))`` with the quintic step s, so position, velocity and
        acceleration of the move are continuous.
        """
        starts = starts_of(start, count=len(plans), state_dim=self.state_dim)
        r = (torch.arange(self.horizon + 1, dtype=torch.float64) / (FADE * self.horizon)).clamp(max=1.0)
        left = 1 - r**3 * (10 - 15 * r + 6 * r**2)
        settled = plans + left[:, None] * (starts - plans[:, 0])[:, None]
        settled[:, 0] = starts
        return settled

    def sample(self, start: Tensor, goal: Box, *, scene: Scene, count: int, generator: torch.Generator) -> Tensor:
        """References ``(count, K+1, n)``, see :class:`~sagemp_cli.planners.base.Planner`: settled proposals.

        Raises:
            NonFiniteError: the generation overflowed.
        """
        plans = self.propose(start, goal, scene=scene, count=count, generator=generator)
        return self.settle(plans, start)


class GenerativeLoss(ABC):
    """Draws batches of demonstrations with noise and generative times; a subclass says what is to be answered.

    Args:
        planner: encodes the demonstrations; it must be prepared on them before.
        demonstrations: ``(D, K+1, n)``.
        steps: number of updates of the whole training; not used.
        batch_size: demonstrations per update.
    """

    def __init__(
        self, planner: GenerativePlanner, demonstrations: Tensor, *, steps: Count, batch_size: Count = 128
    ) -> None:
        if batch_size < 1:
            raise ConfigError(f"planner loss: batch_size must be positive, found {batch_size}")
        self._knots = planner.encode(demonstrations)
        self._starts, self._ends = demonstrations[:, 0], demonstrations[:, -1]
        self._batch = batch_size

    def __call__(
        self, module: GenerativePlanner, step: int, generator: torch.Generator
    ) -> tuple[Tensor, Mapping[str, float]]:
        """The loss of one update, see :data:`sagemp_cli.learning.fit.Loss`."""
        which = torch.randint(len(self._knots), (self._batch,), generator=generator)
        ends = self._ends[which]
        shift = 2 * torch.rand(ends.shape, generator=generator, dtype=torch.float64) - 1
        conditions = module.conditions(self._starts[which], ends + shift * module.goal_radius)
        knots = self._knots[which]
        noise = torch.randn(knots.shape, generator=generator)
        u = torch.rand(self._batch, generator=generator)
        return self.error(module, knots, noise, u, conditions), {}

    @abstractmethod
    def error(self, module: Any, knots: Tensor, noise: Tensor, u: Tensor, conditions: Conditions) -> Tensor:
        """The scalar to minimise for knots and noise ``(B, M, n)`` and uniform numbers ``u (B,)`` in [0, 1)."""
