"""Open-loop execution: the controls of a plan played back, whatever happens to the robot."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.dynamics.base import Dynamics


@dataclass(frozen=True)
class OpenLoop:
    """The robot under fixed controls; answers :meth:`rollout` as a closed loop does.

    Attributes:
        dynamics: the robot.
        controls: ``(..., K, m)``; leading dimensions are batch and broadcast against those of the state.
    """

    dynamics: Dynamics
    controls: Tensor

    @property
    def horizon(self) -> int:
        """Number of steps K."""
        return self.controls.shape[-2]

    @property
    def state_dim(self) -> int:
        """Number of states n."""
        return self.dynamics.state_dim

    def rollout(self, x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
        """States ``(..., K+1, n)`` and the controls ``(..., K, m)``, from starts ``(..., n)`` under ``w (..., K, d)``.

        Fewer rows of ``w`` give a shorter rollout. Where a control would lag it comes late here too.
        """
        w, dynamics = self.dynamics.completed(w), self.dynamics
        steps, states = w.shape[-2], [x]
        controls = self.controls[..., :steps, :].expand(*x.shape[:-1], steps, -1)
        for k in range(steps):
            held, u, now = controls[..., max(k - 1, 0), :], controls[..., k, :], w[..., k, :]
            after = (
                dynamics.lagged(states[-1], held, u, now) if dynamics.control_lag else dynamics.step(states[-1], u, now)
            )
            states.append(after)
        return torch.stack(states, dim=-2), controls
