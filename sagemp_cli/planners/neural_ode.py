"""The neural-ODE planner: ``x' = phi(x, t)`` integrated from the start; and its loss."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from sagemp_cli.config.ranges import Count, NonNegative, Positive, Share, Whole, Widths
from sagemp_cli.errors import ConfigError, NonFiniteError
from sagemp_cli.planners.base import starts_of
from sagemp_cli.planners.networks import TimeMLP
from sagemp_cli.planners.normalizer import Normalizer
from sagemp_cli.scenes.scene import Scene
from sagemp_cli.sets import Box

METHODS = ("euler", "rk4")


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
        steps: Count,
        batch_size: Count = 64,
        points: Count = 1024,
        derivative_share: Share = 0.7,
        first_window: Count = 25,
        spread: NonNegative = 0.05,
        pull: NonNegative = 10.0,
        hold: NonNegative = 0.1,
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
        """The loss of update ``step`` and its parts, see :data:`sagemp_cli.learning.fit.Loss`."""
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


class NeuralODE(nn.Module):
    """A vector field learned from demonstrations; a reference is its solution from the start.

    The field works on normalised states ``z`` and normalised time ``s = k / K`` in [0, 1]: ``dz/ds = phi(z, s)``.
    It is deterministic: which side of an obstacle a plan takes follows from the start. Diversity comes from
    different starts and from a random drift in the integration (``noise``).

    The drift is a stationary Ornstein-Uhlenbeck process, one per state, added to the field: its standard deviation
    is ``noise`` in state units per second and its correlation time ``noise_time`` in seconds. It is coloured rather
    than white because white noise that is strong enough to change a plan makes it too jagged to track.

    The network computes in float32. Its rounding is no concern of the proof, which takes a stored reference as
    exact numbers.

    Args:
        state_dim: number of states n.
        horizon: number of steps K.
        dt: seconds a step.
        hidden: widths of the hidden layers.
        frequencies: time features of the network.
        method: ``"euler"`` (with one substep: the map that the robot's own Euler step has) or ``"rk4"``.
        substeps: integration steps per reference step.
        noise: see above, one number or n.
        noise_time: see above.
    """

    learns_from: ClassVar[str] = "demonstrations"
    loss_type: ClassVar = NeuralODELoss

    def __init__(
        self,
        *,
        state_dim: Count,
        horizon: Count,
        dt: Positive,
        hidden: Widths,
        frequencies: Whole = 3,
        method: Literal["euler", "rk4"] = "euler",
        substeps: Count = 1,
        noise: NonNegative | Sequence[NonNegative] = 0.0,
        noise_time: Positive = 1.0,
    ) -> None:
        super().__init__()
        if state_dim < 1 or horizon < 1 or substeps < 1:
            raise ConfigError(
                "planner: state_dim, horizon and substeps must be positive, "
                f"found {state_dim}, {horizon} and {substeps}"
            )
        if not 0 < dt < math.inf or not 0 < noise_time < math.inf:
            raise ConfigError(f"planner: dt and noise_time must be positive seconds, found {dt} and {noise_time}")
        if method not in METHODS:
            raise ConfigError(f"planner: method must be one of {METHODS}, found '{method}'")
        self.state_dim, self.horizon, self.dt = int(state_dim), int(horizon), float(dt)
        self.hidden, self.frequencies = [int(h) for h in hidden], int(frequencies)
        self.method, self.substeps, self.noise_time = method, int(substeps), float(noise_time)
        self.noise = self._per_state(noise)
        self.normalizer = Normalizer(state_dim)
        self.field = TimeMLP(state_dim, state_dim, hidden=self.hidden, frequencies=self.frequencies)

    @property
    def arguments(self) -> dict[str, Any]:
        """Plain keyword arguments that rebuild this planner; its weights are in ``state_dict()``."""
        return {
            "state_dim": self.state_dim,
            "horizon": self.horizon,
            "dt": self.dt,
            "hidden": self.hidden,
            "frequencies": self.frequencies,
            "method": self.method,
            "substeps": self.substeps,
            "noise": self.noise,
            "noise_time": self.noise_time,
        }

    def prepare(self, demonstrations: Tensor, *, goal: Box, generator: torch.Generator) -> None:
        """Fit the normaliser to demonstrations ``(D, K+1, n)`` and draw initial weights; the goal is theirs."""
        self.normalizer.fit(demonstrations)
        self.field.reset(generator)

    def advance(self, z: Tensor, first: int | Tensor, count: int, *, drift: Tensor | None = None) -> Tensor:
        """Integrate ``count`` reference steps from step ``first``, differentiably.

        Args:
            z: normalised states ``(..., n)`` at step ``first``, in the network's dtype.
            first: index of the step, one number or a batch ``(...)`` as a tensor.
            count: number of steps.
            drift: added to the field, constant over a step, ``(count, ..., n)`` in normalised states per unit of
                normalised time.

        Returns:
            States at steps ``first + 1 .. first + count``, stacked in a new dimension before the last.
        """
        h = 1.0 / (self.horizon * self.substeps)
        # Times of all stages at once, in half integration steps: [first, first + h/2, first + h, ...].
        halves = torch.arange(2 * count * self.substeps + 1, dtype=z.dtype) * (0.5 * h)
        times = self.field.embed(torch.as_tensor(first, dtype=z.dtype)[..., None] / self.horizon + halves)
        times = times.unbind(-2)
        states = []
        for j in range(count):
            push = None if drift is None else drift[j]
            for i in range(2 * j * self.substeps, 2 * (j + 1) * self.substeps, 2):
                slope = self._slope(z, times[i : i + 3], h, push)
                z = z + h * slope
            states.append(z)
        return torch.stack(states, dim=-2)

    def _slope(self, z: Tensor, times: Sequence[Tensor], h: float, push: Tensor | None) -> Tensor:
        """The mean of field and drift over one integration step, as the method estimates it."""

        def slope(z: Tensor, time: Tensor) -> Tensor:
            return self.field.at(z, time) if push is None else self.field.at(z, time) + push

        begin, middle, end = times
        a = slope(z, begin)
        if self.method == "euler":
            return a
        b = slope(z + 0.5 * h * a, middle)
        c = slope(z + 0.5 * h * b, middle)
        d = slope(z + h * c, end)
        return (a + 2 * b + 2 * c + d) / 6

    def forward(self, starts: Tensor, *, drift: Tensor | None = None) -> Tensor:
        """References ``(..., K+1, n)``, float64, from starts ``(..., n)``; row 0 is the start to the last bit."""
        starts = starts.to(torch.float64)
        z = self.advance(self.normalizer.normalize(starts).float(), 0, self.horizon, drift=drift)
        return torch.cat([starts[..., None, :], self.normalizer.denormalize(z.double())], dim=-2)

    @torch.no_grad()
    def sample(
        self,
        start: Tensor,
        goal: Box,
        *,
        scene: Scene,
        count: int,
        generator: torch.Generator,
        noise: float | Sequence[float] | None = None,
    ) -> Tensor:
        """References ``(count, K+1, n)``, see :class:`~sagemp_cli.planners.base.Planner`.

        The field was trained for one scene and goal, so ``goal`` and ``scene`` are not looked at.
        ``noise`` defaults to what the planner was built with; without any, equal starts give equal references.

        Raises:
            NonFiniteError: the integration overflowed.
        """
        sigma = self.noise if noise is None else self._per_state(noise)
        starts = starts_of(start, count=count, state_dim=self.state_dim)
        drift = self._drift(count, sigma, generator) if any(sigma) else None
        references = self(starts, drift=drift)
        if not bool(torch.isfinite(references).all()):
            raise NonFiniteError("planner: a sampled reference contains NaN or infinity; train the planner longer")
        return references

    def _drift(self, count: int, sigma: Sequence[float], generator: torch.Generator) -> Tensor:
        """Paths of the drift ``(K, count, n)`` in normalised states per unit of normalised time."""
        white = torch.randn(self.horizon, count, self.state_dim, generator=generator)
        keep = math.exp(-self.dt / self.noise_time)
        value = white[0]
        path = [value]
        for xi in white[1:]:
            value = keep * value + math.sqrt(1 - keep * keep) * xi
            path.append(value)
        unit = torch.tensor(sigma, dtype=torch.float64) * self.horizon * self.dt / self.normalizer.scale
        return torch.stack(path) * unit.float()

    def _per_state(self, value: float | Sequence[float]) -> list[float]:
        values = [float(v) for v in value] if isinstance(value, Sequence) else [float(value)] * self.state_dim
        if len(values) != self.state_dim or not all(0 <= v < math.inf for v in values):
            raise ConfigError(
                f"planner: noise needs one number or {self.state_dim}, finite and not negative, found {value}"
            )
        return values
