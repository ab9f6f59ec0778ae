"""Loops, sets and rollouts that the tests of several propagators share."""

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.dynamics import Unicycle
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.sets import Box
from sagemp_cli.trackers import Tracker

K = 12


def unicycle_loop(*references: Tensor, gain: float = 0.5) -> ClosedLoop:
    """A unicycle under a random small tracker, with one reference or a batch of them."""
    robot = Unicycle(
        dt=0.1,
        control_lower=[-2.0] * 2,
        control_upper=[2.0] * 2,
        state_lower=[-10.0] * 4,
        state_upper=[10.0] * 4,
    )
    tracker = Tracker(state_dim=4, control_dim=2, lookahead=2, hidden=[6, 6])
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for parameter in tracker.parameters():
            parameter.copy_(gain * torch.randn(parameter.shape, dtype=torch.float64, generator=generator))
    return ClosedLoop(
        robot, tracker.requires_grad_(False), torch.stack(references)[:, None] if references[1:] else references[0]
    )


def line(heading: float) -> Tensor:
    """A straight reference at 1 m/s, ``(K+1, 4)``."""
    t = 0.1 * torch.arange(K + 1, dtype=torch.float64)
    one = torch.ones_like(t)
    return torch.stack([t, heading * t, heading * one, one], dim=-1)


START = Box.around([0.0, 0.0, 0.1, 1.0], [0.2, 0.2, 0.1, 0.1])
DISTURBANCE = Box.around([0.0] * 4, [0.05, 0.05, 0.1, 0.1])


@dataclass(frozen=True)
class AffineLoop:
    """``x+ = A x + B w + c k``, whose reach sets are known in closed form."""

    horizon: int = 8
    state_dim: int = 2
    matrix: tuple[tuple[float, float], tuple[float, float]] = ((0.9, 0.3), (-0.2, 0.8))

    def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
        return x @ torch.tensor(self.matrix, dtype=torch.float64).T + 0.5 * w + (0.1 * k)

    def reach(self, start: Box, disturbance: Box) -> tuple[Tensor, Tensor]:
        """Exact lower and upper bounds of every step, ``(K+1, 2)`` each."""
        a = torch.tensor(self.matrix, dtype=torch.float64)
        center, power, noise = start.center, torch.eye(2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
        lower, upper = [start.lower], [start.upper]
        for k in range(self.horizon):
            center = a @ center + 0.5 * disturbance.center + 0.1 * k
            noise = noise + 0.5 * power.abs() @ disturbance.radius
            power = a @ power
            reach = noise + power.abs() @ start.radius
            lower.append(center - reach)
            upper.append(center + reach)
        return torch.stack(lower), torch.stack(upper)


@dataclass(frozen=True)
class EveryOperation:
    """A loop that uses most operations the native propagators know, on intervals that meet kinks and inflections."""

    horizon: int = 3
    state_dim: int = 3

    def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
        a, b, c = torch.unbind(x, -1)
        first = torch.tanh(a) * torch.sigmoid(b) + torch.clamp(c, -0.3, 0.4) - torch.relu(a * a - 0.1)
        second = torch.maximum(torch.sin(3 * a), torch.cos(b)) / (2.0 + torch.square(c)) + 0.1 * torch.atan2(a, 2.0 + b)
        third = torch.nn.functional.softplus(a - b) - torch.abs(c) + torch.sqrt(1.0 + b * b) - torch.exp(-(c**2))
        fourth = torch.nn.functional.silu(a) + torch.minimum(b, c) - torch.log(3.0 + a) + torch.tan(0.3 * b) - b**3
        return 0.4 * torch.stack([first, second - 0.1 * fourth, 0.3 * third], -1) + w


def rollouts(loop, start: Box, disturbance: Box, count: int = 300, seed: int = 0) -> Tensor:
    """States ``(rollouts, K+1, n)``: random, from the corners, and under bang-bang disturbances."""
    generator = torch.Generator().manual_seed(seed)
    corners = torch.tensor(
        list(itertools.product(*zip(start.lower.tolist(), start.upper.tolist(), strict=True))), dtype=torch.float64
    )
    x = torch.cat([corners, start.sample(count, generator)])
    w = disturbance.sample(len(x) * loop.horizon, generator).unflatten(0, (len(x), loop.horizon))
    x, w = torch.cat([x, x]), torch.cat([w, torch.where(w > disturbance.center, disturbance.upper, disturbance.lower)])
    states = [x]
    with torch.no_grad():
        for k in range(loop.horizon):
            states.append(loop.step(k, states[-1], w[:, k]))
    return torch.stack(states, dim=-2)
