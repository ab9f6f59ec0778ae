"""The loss that a neural-ODE planner is trained with."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from sagemp_cli.errors import ConfigError

if TYPE_CHECKING:
    from sagemp_cli.planners.neural_ode import NeuralODE


class NeuralODELoss:
    """Mean squared distance between demonstrations and the planner's solutions, in normalised states.

    Two phases. First derivative matching: at demonstrated states ``z_k`` moved by noise ``d``, the field is to be
    ``(z_{k+1} - z_k) / h - pull d``. This is ordinary regression, cheap and without long gradients, and the pull
    makes demonstrations attract, so that errors do not add up along a plan. Between demonstrations that are close
    to each other the noise cancels, so the pull acts at the edge of the data and not against their spread.

    Then the trajectory loss of a neural ODE: integrate over windows of the demonstrations and back-propagate
    through the integration. Windows grow from ``first_window`` steps to the whole horizon. Derivative matching goes on
    beside it with the weight ``hold``, which keeps what the pull has achieved.

    Args:
        planner: gives normaliser and horizon; it must be prepared on the demonstrations before.
        demonstrations: ``(D, K+1, n)``. One per start: a deterministic planner can only take one side.
        steps: number of updates of the whole training.
        batch_size: windows per update of the second phase.
        points: demonstrated states per update of derivative matching.
        derivative_share: share of the updates in the first phase.
        first_window: length of the first windows in steps.
        spread: standard deviation of the noise, in normalised states.
        pull: rate of attraction per unit of normalised time (10: a deviation shrinks by ``exp(-10)`` over a plan).
        hold: weight of derivative matching in the second phase.
    """

    def __init__(
        self,
        planner: NeuralODE,
        demonstrations: Tensor,
        *,
        steps: int,
        batch_size: int = 64,
        points: int = 1024,
        derivative_share: float = 0.7,
        first_window: int = 25,
        spread: float = 0.05,
        pull: float = 10.0,
        hold: float = 0.1,
    ) -> None:
        if not 0 <= derivative_share <= 1 or min(batch_size, points, first_window) < 1 or min(spread, pull, hold) < 0:
            raise ConfigError(
                "planner loss: derivative_share must lie in [0, 1], batch_size, points and first_window be positive, "
                f"spread, pull and hold not negative, found {derivative_share}, {batch_size}, {points}, "
                f"{first_window}, {spread}, {pull} and {hold}"
            )
        self._states = planner.normalizer.normalize(demonstrations).float()
        self._horizon = planner.horizon
        self._steps, self._derivative_steps = steps, round(derivative_share * steps)
        self._batch, self._points = batch_size, points
        self._first_window = min(first_window, planner.horizon)
        self._spread, self._pull, self._hold = spread, pull, hold

    def __call__(self, module: NeuralODE, step: int, generator: torch.Generator) -> tuple[Tensor, Mapping[str, float]]:
        """The loss of update ``step`` and its parts, see :data:`sagemp_cli.training.Loss`."""
        derivative = self._derivative(module, generator)
        figures = {"derivative loss": float(derivative.detach())}
        if step < self._derivative_steps:
            return derivative, figures
        trajectory = self._trajectory(module, self.window(step), generator)
        figures["trajectory loss"] = float(trajectory.detach())
        return trajectory + self._hold * derivative, figures

    def window(self, step: int) -> int:
        """Length of the windows in update ``step``: grows geometrically; the last third has the whole horizon."""
        phase = 1.5 * (step - self._derivative_steps) / max(1, self._steps - self._derivative_steps)
        return round(self._first_window * (self._horizon / self._first_window) ** min(1.0, max(0.0, phase)))

    def _derivative(self, module: NeuralODE, generator: torch.Generator) -> Tensor:
        which = torch.randint(len(self._states), (self._points,), generator=generator)
        k = torch.randint(self._horizon, (self._points,), generator=generator)
        here, there = self._states[which, k], self._states[which, k + 1]
        offset = self._spread * torch.randn(here.shape, generator=generator)
        wanted = (there - here) * self._horizon - self._pull * offset
        return nn.functional.mse_loss(module.field(here + offset, k / self._horizon), wanted)

    def _trajectory(self, module: NeuralODE, length: int, generator: torch.Generator) -> Tensor:
        which = torch.randint(len(self._states), (self._batch,), generator=generator)
        first = torch.randint(self._horizon - length + 1, (self._batch,), generator=generator)
        window = self._states[which[:, None], first[:, None] + torch.arange(length + 1)]
        return nn.functional.mse_loss(module.advance(window[:, 0], first, length), window[:, 1:])
