"""The flow-matching planner: noise is carried to plans along a learned velocity."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from sagemp_cli.config.ranges import Count
from sagemp_cli.errors import ConfigError
from sagemp_cli.planners.generative import Conditions, GenerativeLoss, GenerativePlanner

STAGES = {
    "euler": ((0.0,), (1.0,)),
    "midpoint": ((0.0, 0.5), (0.0, 1.0)),
    "heun": ((0.0, 1.0), (0.5, 0.5)),
    "rk4": ((0.0, 0.5, 0.5, 1.0), (1 / 6, 1 / 3, 1 / 3, 1 / 6)),
}
"""Explicit Runge-Kutta methods as nodes and weights. Stage i starts from stage i-1's slope alone, as in all four."""


def integrate(
    velocity: Callable[[Tensor, float], Tensor], z: Tensor, *, steps: int, method: str, until: float = 1.0
) -> Tensor:
    """The solution of ``dz/dt = velocity(z, t)`` at t = ``until`` from ``z`` at t = 0, in equal steps (0: ``z``)."""
    nodes, weights = STAGES[method]
    h = until / max(1, steps)
    for i in range(steps):
        slope, total = torch.zeros_like(z), torch.zeros_like(z)
        for node, weight in zip(nodes, weights, strict=True):
            slope = velocity(z + h * node * slope, h * (i + node))
            total = total + weight * slope
        z = z + h * total
    return z


class FlowMatchingLoss(GenerativeLoss):
    """Conditional flow matching with straight paths (Lipman et al. 2023; rectified flow, Liu et al. 2023).

    On ``z_t = (1 - t) noise + t knots``, t uniform, the velocity is to be ``knots - noise`` in the mean square. Its
    minimiser is the velocity whose flow carries the noise to the demonstrations. The network answers where the straight
    path ends, not the velocity ``(answer - z_t) / (1 - t)`` itself: so it need not carry the noise through, and its
    error does not stay in the plan as roughness. The mean square of the velocity is then ``|answer - knots|^2 / (1 -
    t)^2``, whose weight stops growing at ``1 - t = 0.1``, or the last instants would drown the rest.
    """

    def error(self, module: FlowMatching, knots: Tensor, noise: Tensor, u: Tensor, conditions: Conditions) -> Tensor:
        """See :meth:`GenerativeLoss.error`."""
        t = u[:, None, None]
        miss = module.answer((1 - t) * noise + t * knots, u, conditions) - knots
        return (miss / (1 - t).clamp(min=0.1)).square().mean()


class FlowMatching(GenerativePlanner):
    """Plans by conditional flow matching; see :class:`~sagemp_cli.planners.generative.GenerativePlanner`.

    Sampling integrates the learned velocity from noise at t = 0 to a plan at t = 1. The last step is one of Euler's
    whatever the method: it lands on the network's answer, and nothing is evaluated at t = 1, where the velocity is 0/0.

    Args:
        method: ``"euler"``, ``"midpoint"``, ``"heun"`` or ``"rk4"``: one, two, two or four evaluations a step.
        integration_steps: number of steps, the last one included.
        common: those of every generative planner.
    """

    loss_type: ClassVar = FlowMatchingLoss

    def __init__(
        self,
        *,
        method: Literal["euler", "midpoint", "heun", "rk4"] = "midpoint",
        integration_steps: Count = 10,
        **common: Any,
    ) -> None:
        super().__init__(**common)
        if method not in STAGES:
            raise ConfigError(f"planner: method must be one of {tuple(STAGES)}, found '{method}'")
        if integration_steps < 1:
            raise ConfigError(f"planner: integration_steps must be positive, found {integration_steps}")
        self.method, self.integration_steps = method, int(integration_steps)

    @property
    def arguments(self) -> dict[str, Any]:
        """Plain keyword arguments that rebuild this planner; its weights are in ``state_dict()``."""
        return super().arguments | {"method": self.method, "integration_steps": self.integration_steps}

    def generate(self, noise: Tensor, conditions: Conditions, *, generator: torch.Generator) -> Tensor:
        """The flow at t = 1; nothing but ``noise`` is random, so ``generator`` is not drawn from."""

        def velocity(z: Tensor, t: float) -> Tensor:
            return (self.answer(z, z.new_full((len(z),), t), conditions) - z) / (1 - t)

        last = 1.0 - 1.0 / self.integration_steps
        z = integrate(velocity, noise, steps=self.integration_steps - 1, method=self.method, until=last)
        return self.answer(z, z.new_full((len(z),), last), conditions)
