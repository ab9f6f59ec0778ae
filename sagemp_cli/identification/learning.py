"""Fitting a learned robot's network to its analytical model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from sagemp_cli.config.ranges import Count, Decay, NonNegative, Part, Positive
from sagemp_cli.dynamics.learned import Layers, Learned, perceptron
from sagemp_cli.errors import ConfigError
from sagemp_cli.identification.enclosure_loss import enclosure_error
from sagemp_cli.identification.transitions import Transitions, domain_of
from sagemp_cli.learning.checkpoint import Resumable
from sagemp_cli.learning.fit import History, fit
from sagemp_cli.learning.schedule import Schedule
from sagemp_cli.progress import Progress
from sagemp_cli.sets import Box

BINS = 60
"""Of the error histograms."""


@dataclass(frozen=True)
class ModelErrors:
    """Errors of the predicted derivative on transitions that were held out, in units of each state per second.

    Attributes:
        rms, largest: per state, ``(n,)``.
        edges: of the histograms' bins, evenly over [-largest, largest], ``(n, bins + 1)``.
        counts: transitions in each bin, ``(n, bins)``.
    """

    rms: np.ndarray
    largest: np.ndarray
    edges: np.ndarray
    counts: np.ndarray


@dataclass(frozen=True)
class EnclosureWeight:
    """How much a network's enclosures count in training, see :mod:`sagemp_cli.identification.enclosure_loss`.

    Attributes:
        weight: of the mean relaxation error, increments in units of their spread.
        radius: widest boxes, as a share of half the range of each input; widths are drawn uniformly below it.
        boxes: drawn for each update.
        start: share of the training over which the weight grows from 0.
    """

    weight: NonNegative = 0.01
    radius: Part = 0.4
    boxes: Count = 16
    start: Part = 0.2

    def __post_init__(self) -> None:
        if not self.weight >= 0 or not 0 < self.radius <= 1 or self.boxes < 1 or not 0 < self.start <= 1:
            raise ConfigError(
                "dynamics_training.enclosure needs weight >= 0, radius and start in (0, 1] and boxes >= 1, found "
                f"{self.weight}, {self.radius}, {self.start} and {self.boxes}"
            )


@dataclass(frozen=True, kw_only=True)
class DynamicsTrainingOptions(Schedule):
    """How a robot's network learns.

    Attributes:
        transitions: how many are drawn to learn from; the paper has 2e6 for the unicycle.
        held_out: how many more are drawn, between the robot's limits, to measure the error.
        margin: share of each range that learning goes beyond the limits: errors are largest at the edge of the data.
        batch: transitions in an update.
        enclosure: the second part of the loss; None for none.
    """

    steps: Count = 12_000
    learning_rate: Positive = 5e-3
    ema_decay: Decay | None = 0.995
    transitions: Count = 2_000_000
    held_out: Count = 100_000
    margin: NonNegative = 0.1
    batch: Count = 512
    enclosure: EnclosureWeight | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("transitions", "held_out", "batch"):
            if getattr(self, name) < 1:
                raise ConfigError(
                    f"dynamics_training.{name} must be a positive whole number, found {getattr(self, name)}"
                )
        if not 0 <= self.margin < float("inf"):
            raise ConfigError(f"dynamics_training.margin must not be negative, found {self.margin}")


def learn_dynamics(
    robot: Learned,
    options: DynamicsTrainingOptions,
    *,
    generator: torch.Generator,
    resumable: Resumable | None = None,
    progress: Progress | None = None,
) -> tuple[History, ModelErrors]:
    """Fit the robot's network to its analytical model, in place: mean squared error of the increments, each state's
    divided by its spread over the data, and the enclosure error.

    Args:
        robot: what learns; its weights before do not matter.
        options: what it learns from, and how long.
        generator: source of all randomness.
        resumable, progress: see :func:`~sagemp_cli.learning.fit.fit`.

    Returns:
        The course of training, with the validation's root mean square error per state in units of the state per second,
        and the errors of what the robot then holds.
    """
    enclosure, domain = options.enclosure, domain_of(robot.analytical, options.margin)
    data = Transitions.draw(robot.analytical, domain, options.transitions, generator)
    unseen = Transitions.draw(robot.analytical, domain_of(robot.analytical), options.held_out, generator)
    network = _Network(robot, domain, data.increments, generator)
    inputs, targets = network.prepared(data)
    unseen_inputs, unseen_targets = network.prepared(unseen)
    del data

    def loss(module: nn.Module, step: int, generator: torch.Generator) -> tuple[Tensor, Mapping[str, float]]:
        chosen = torch.randint(len(inputs), (options.batch,), generator=generator)
        error = (module(inputs[chosen]) - targets[chosen]).square().mean()
        if enclosure is None:
            return error, {}
        cost = network.enclosure_cost(module, enclosure, generator)
        weight = enclosure.weight * min(1.0, (step + 1) / (enclosure.start * options.steps))
        return error + weight * cost, {"squared error": float(error.detach()), "enclosure": float(cost.detach())}

    def validate(module: nn.Module) -> Mapping[str, float]:
        error = (module(unseen_inputs) - unseen_targets).square().mean(0).sqrt().double() * network.spread
        return {f"{name} error": float(e) for name, e in zip(robot.state_names, error, strict=True)}

    history = fit(
        network,
        loss,
        options,
        generator=generator,
        validate=validate,
        resumable=resumable,
        progress=progress,
        description="learning the dynamics",
    )
    network.put_into(robot)
    return history, model_errors(robot, unseen)


@torch.no_grad()
def model_errors(robot: Learned, data: Transitions) -> ModelErrors:
    """How far the robot's predictions are from the data."""
    x, u = data.inputs.split([robot.state_dim, robot.control_dim], dim=-1)
    error = (robot.derivative(x, u) - data.increments).numpy()
    largest = np.abs(error).max(axis=0)
    edges = np.where(largest > 0, largest, 1.0)[:, None] * np.linspace(-1.0, 1.0, BINS + 1)
    counts = [np.histogram(error[:, i], bins=edges[i])[0] for i in range(error.shape[1])]
    return ModelErrors(np.sqrt(np.square(error).mean(axis=0)), largest, edges, np.stack(counts).astype(np.int64))


class _Network(nn.Module):
    """The network while it learns: float32, inputs scaled to [-1, 1], increments to unit variance."""

    def __init__(self, robot: Learned, domain: Box, increments: Tensor, generator: torch.Generator) -> None:
        super().__init__()
        self.activation, self.columns = robot.activation, list(robot.reads)
        self.center, self.scale = domain.center[self.columns], domain.radius[self.columns]
        self.mean, self.spread = increments.mean(0), increments.std(0).clamp(min=1e-6)
        widths = [len(self.columns), *(layer.out_features for layer in robot.layers)]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(torch.randint(2**31, (), generator=generator)))
            self.layers = Layers(nn.Linear(a, b) for a, b in zip(widths[:-1], widths[1:], strict=True))

    def forward(self, inputs: Tensor) -> Tensor:
        """Normalised increments from normalised inputs."""
        return perceptron(self.layers, self.activation, inputs)

    def prepared(self, data: Transitions) -> tuple[Tensor, Tensor]:
        """Normalised inputs and increments in float32."""
        inputs = ((data.inputs[:, self.columns] - self.center) / self.scale).float()
        return inputs, ((data.increments - self.mean) / self.spread).float()

    def enclosure_cost(self, module: nn.Module, wanted: EnclosureWeight, generator: torch.Generator) -> Tensor:
        """Mean enclosure error over random boxes that lie in the domain."""
        assert isinstance(module, _Network)
        shape = (wanted.boxes, len(self.columns))
        radius = wanted.radius * torch.rand(shape, generator=generator)
        center = (2 * torch.rand(shape, generator=generator) - 1) * (1 - radius)
        return enclosure_error(list(module.layers), module.activation, center, radius).mean()

    @torch.no_grad()
    def put_into(self, robot: Learned) -> None:
        """The same network in the robot's units, as plain layers in float64."""
        weights = [layer.weight.double() for layer in self.layers]
        biases = [layer.bias.double() for layer in self.layers]
        first = weights[0] / self.scale
        biases[0] = biases[0] - first @ self.center
        weights[0] = torch.zeros(len(first), robot.state_dim + robot.control_dim, dtype=torch.float64)
        weights[0][:, self.columns] = first
        weights[-1] = weights[-1] * self.spread[:, None]
        biases[-1] = biases[-1] * self.spread + self.mean
        for layer, weight, bias in zip(robot.layers, weights, biases, strict=True):
            layer.weight.copy_(weight)
            layer.bias.copy_(bias)
