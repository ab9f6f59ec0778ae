"""A learned robot model: a multi-layer perceptron that predicts the state increment of one step."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, cast

import torch
from torch import Tensor, nn

from sagemp_cli.config.ranges import Widths
from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.dynamics.lag import Seconds
from sagemp_cli.errors import ConfigError, did_you_mean

NEGATIVE_SLOPE = 0.1
"""Of ``leaky_relu``."""

ACTIVATIONS: Mapping[str, Callable[[Any], Any]] = {
    "leaky_relu": functools.partial(nn.functional.leaky_relu, negative_slope=NEGATIVE_SLOPE),
    "silu": nn.functional.silu,
    "softplus": nn.functional.softplus,
    "tanh": torch.tanh,
}
"""What may stand between two layers."""


class Learned(Dynamics):
    """The robot of ``model`` with its increment read from a network, ``x_{k+1} = x_k + dt (MLP(x_k, u_k) + w_k)``.

    States, controls, limits, dt and the reading of w are those of the analytical model. The network predicts the
    increment of one step divided by dt, so that the step is that of :class:`~sagemp_cli.dynamics.base.Dynamics`. It is
    made of plain layers in the units of the robot: what normalises inputs and outputs in training is folded into the
    first and the last, so that a proof speaks about the very numbers that are stored. Until weights are loaded
    (``load_state_dict``; :mod:`sagemp_cli.identification` makes them) they are NaN, and so is every derivative.

    Args:
        model: the analytical model.
        hidden: widths of the hidden layers; the paper has three of 64.
        activation: one of :data:`ACTIVATIONS`; the paper does not say which.
        inputs: names of the states that the network reads, all by default; it reads all controls. The columns of the
            first layer that belong to other states are zero: a robot that moves alike wherever it is need not be told
            where that is, and a wide set of positions then costs the proof nothing.
        time, delay, jitter: see :class:`~sagemp_cli.dynamics.base.Dynamics`; those of the model by default.
    """

    def __init__(
        self,
        *,
        model: Dynamics,
        hidden: Widths,
        activation: Literal["leaky_relu", "silu", "softplus", "tanh"] = "silu",
        inputs: list[str] | None = None,
        time: Literal["discrete", "continuous"] | None = None,
        delay: Seconds | None = None,
        jitter: Seconds | None = None,
    ) -> None:
        robot = model
        if isinstance(robot, Learned):
            raise ConfigError("dynamics.model must be an analytical robot model, found Learned")
        if not hidden or min(hidden) < 1:
            raise ConfigError(f"dynamics.hidden must list positive widths, found {hidden}")
        if activation not in ACTIVATIONS:
            near = did_you_mean(activation, ACTIVATIONS)
            raise ConfigError(
                f"dynamics.activation must be one of {', '.join(ACTIVATIONS)}, found '{activation}'{near}"
            )
        # Before the base class, whose checks ask for the dimensions.
        self.state_names, self.state_units = robot.state_names, robot.state_units
        self.control_names, self.control_units = robot.control_names, robot.control_units
        self.position, self.angles, self.rates = robot.position, robot.angles, robot.rates
        super().__init__(
            dt=robot.dt,
            control_lower=robot.control_lower.tolist(),
            control_upper=robot.control_upper.tolist(),
            state_lower=robot.state_lower.tolist(),
            state_upper=robot.state_upper.tolist(),
            disturbance=robot.disturbance,
            time=robot.time if time is None else time,
            delay=list(robot.control_lag.delay) if delay is None else delay,
            jitter=list(robot.control_lag.jitter) if jitter is None else jitter,
        )
        self.model = robot
        self.activation = activation
        self.reads = self._columns(self.state_names if inputs is None else inputs)
        widths = (self.state_dim + self.control_dim, *hidden, self.state_dim)
        self.layers = Layers(nn.Linear(a, b, dtype=torch.float64) for a, b in zip(widths[:-1], widths[1:], strict=True))
        self.requires_grad_(False)
        for parameter in self.layers.parameters():
            parameter.fill_(torch.nan)

    @property
    def analytical(self) -> Dynamics:
        """The model that this one was learned from."""
        return self.model

    def derivative(self, x: Tensor, u: Tensor) -> Tensor:
        """The predicted increment over dt, divided by dt, see :class:`~sagemp_cli.dynamics.base.Dynamics`."""
        return perceptron(self.layers, self.activation, torch.cat([x, u], dim=-1))

    def compared(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """The predicted derivative, and the deviation ``e``: what w has to be changed by for this model to make the
        analytical model's step, ``step(x, u, w + e) = analytical.step(x, u, w)``; each ``(..., n)``.
        """
        true = self.model.derivative(x, u)  # first, so that the step itself is the last thing that a proof records
        predicted = self.derivative(x, u)
        deviation = true - predicted
        return predicted, deviation if self.disturbance == "derivative" else deviation * self.dt

    def _columns(self, inputs: Sequence[str]) -> tuple[int, ...]:
        """Columns of ``[x, u]`` that the network reads."""
        for name in inputs:
            if name not in self.state_names:
                near = did_you_mean(name, self.state_names) or f"; known: {', '.join(self.state_names)}"
                raise ConfigError(f"dynamics.inputs: there is no state '{name}'{near}")
        states = (i for i, name in enumerate(self.state_names) if name in inputs)
        return (*states, *range(self.state_dim, self.state_dim + self.control_dim))


class Layers(nn.ModuleList):
    """Linear layers, one after the other."""

    def __iter__(self) -> Iterator[nn.Linear]:
        return cast("Iterator[nn.Linear]", super().__iter__())


def perceptron(layers: Iterable[nn.Linear], activation: str, h: Tensor) -> Tensor:
    """Linear layers with an activation between them, on values of any kind that answers torch's operations."""
    first, *others = layers
    h = nn.functional.linear(h, first.weight, first.bias)
    for layer in others:
        h = nn.functional.linear(ACTIVATIONS[activation](h), layer.weight, layer.bias)
    return h
