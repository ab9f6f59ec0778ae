"""Transitions of an analytical model: what a network learns from and is measured on."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.sets import Box


@dataclass(frozen=True)
class Transitions:
    """Transitions of a model under no disturbance.

    Attributes:
        inputs: ``[x, u]``, ``(count, n + m)``.
        increments: ``(x_next - x) / dt``; of a robot in continuous time ``x'``; ``(count, n)``.
    """

    inputs: Tensor
    increments: Tensor

    @staticmethod
    @torch.no_grad()
    def draw(model: Dynamics, domain: Box, count: int, generator: torch.Generator) -> Transitions:
        """States and controls uniform over a box ``(n + m,)``, one step each, or one instant."""
        inputs = domain.sample(count, generator)
        x, u = inputs.split([model.state_dim, model.control_dim], dim=-1)
        if model.continuous:  # over a period x' is not what it was
            return Transitions(inputs, model.derivative(x, u))
        return Transitions(inputs, (model.step(x, u, torch.zeros_like(x)) - x) / model.dt)


def domain_of(model: Dynamics, margin: float = 0.0) -> Box:
    """The box of states and controls between the robot's limits, each range longer by a share of it at either end."""
    lower = torch.cat([model.state_lower, model.control_lower])
    upper = torch.cat([model.state_upper, model.control_upper])
    more = margin * (upper - lower)
    return Box(lower - more, upper + more)
