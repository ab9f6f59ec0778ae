"""Six 3-D quadrotors whose springs pull them to the swarm's centre: 72 states, a loop of one's own.

It knows nothing of the package but the protocol of a loop: ``step(k, x, w)``, ``horizon`` and ``state_dim``.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.dynamics import Dynamics
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.trackers import Tracker

VELOCITY = slice(6, 9)


@dataclass(frozen=True)
class Swarm:
    """Each robot follows its own reference with its own copy of the tracker, ``x (..., robots * n)``.

    Attributes:
        single: the loops of the robots without springs; their references are the batch.
        spring: ``(robots * n, robots * n)``, what the springs add to the next state, per deviation from ``rest``.
        rest: ``(robots * n,)``, a state in which the springs pull at nobody.
        robots: how many.
    """

    single: ClosedLoop
    spring: Tensor
    rest: Tensor
    robots: int

    @classmethod
    def of(cls, dynamics: Dynamics, tracker: Tracker, reference: Tensor, *, offsets: Tensor, stiffness: float) -> Swarm:
        """A formation: every robot's reference is the same one, shifted by its offset ``(robots, 3)`` in metres.

        ``v_i' += -stiffness ((p_i - mean p) - (o_i - mean o))``, stiffness in 1/s^2.
        """
        robots, n = len(offsets), dynamics.state_dim
        shifted = reference.expand(robots, *reference.shape).clone()
        shifted[..., :3] += offsets[:, None, :]
        pull = torch.eye(robots, dtype=torch.float64) - 1.0 / robots
        spring = torch.zeros(robots, n, robots, n, dtype=torch.float64)
        for velocity, place in zip(range(n)[VELOCITY], range(3), strict=True):
            spring[:, velocity, :, place] = -dynamics.dt * stiffness * pull
        rest = torch.zeros(robots, n, dtype=torch.float64)
        rest[:, :3] = offsets
        return cls(
            ClosedLoop(dynamics, tracker, shifted), spring.reshape(robots * n, robots * n), rest.flatten(), robots
        )

    @property
    def horizon(self) -> int:
        return self.single.horizon

    @property
    def state_dim(self) -> int:
        return self.robots * self.single.state_dim

    def numbers(self) -> Tensor:
        return self.single.numbers().flatten(-2)

    def step_given(self, numbers: Tensor, x: Tensor, w: Tensor) -> tuple[Tensor, None]:
        n = self.single.state_dim
        states, disturbances, windows = (
            v.unflatten(-1, (self.robots, size)) for v, size in ((x, n), (w, n), (numbers, -1))
        )
        alone = torch.flatten(self.single.step_given(windows, states, disturbances)[0], -2)
        return alone + torch.nn.functional.linear(x - self.rest, self.spring), None

    def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
        return self.step_given(self.numbers()[k], x, w)[0]
