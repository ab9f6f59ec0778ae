"""A robot model that is a neural network, 3 x 64, fitted here in seconds: enough to measure time and tightness on."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from sagemp_cli.dynamics import Dynamics, Unicycle
from sagemp_cli.training import fit

WIDTHS = (64, 64, 64)


class LearnedUnicycle(Unicycle):
    """The unicycle with its derivative read from a leaky-ReLU network of heading, speed and controls."""

    def __init__(self, model: Unicycle, *, seed: int = 0, updates: int = 1500, batch: int = 256) -> None:
        super().__init__(
            dt=model.dt,
            control_lower=model.control_lower.tolist(),
            control_upper=model.control_upper.tolist(),
            state_lower=model.state_lower.tolist(),
            state_upper=model.state_upper.tolist(),
            disturbance=model.disturbance,
        )
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            widths = (4, *WIDTHS, 4)
            pairs = zip(widths[:-1], widths[1:], strict=True)
            self.layers = nn.ModuleList(nn.Linear(a, b, dtype=torch.float64) for a, b in pairs)
        self.history = fit(
            self,
            lambda module, step, generator: module._loss(model, batch, generator),
            steps=updates,
            learning_rate=3e-3,
            generator=torch.Generator().manual_seed(seed),
            description="learning the dynamics",
        )
        self.requires_grad_(False)

    def derivative(self, x: Tensor, u: Tensor) -> Tensor:
        h = torch.cat([x[..., 2:4], u], dim=-1)
        for layer in self.layers[:-1]:
            h = nn.functional.leaky_relu(nn.functional.linear(h, layer.weight, layer.bias), 0.1)
        return nn.functional.linear(h, self.layers[-1].weight, self.layers[-1].bias)

    def _loss(self, model: Dynamics, batch: int, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        unit = torch.rand(batch, 6, dtype=torch.float64, generator=generator)
        x = self.state_lower + unit[:, :4] * (self.state_upper - self.state_lower)
        u = self.control_lower + unit[:, 4:] * (self.control_upper - self.control_lower)
        error = (self.derivative(x, u) - model.derivative(x, u)).square().mean()
        return error, {"error": error.sqrt().item()}
