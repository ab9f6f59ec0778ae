"""The tracking neural feedback loop (T-NFL, Algorithm 1 of the paper).

Indices (the paper's Algorithm 1 slips here, see ``docs/glossary.md``): states ``x_0..x_K`` with ``x_0`` the
start, references ``p_0..p_K`` with ``p_0`` the reference's start; step ``k = 0..K-1`` reads
``p_{k+1}..p_{k+N}``, padded with ``p_K``, and the disturbance ``w_k``.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.errors import NonFiniteError, UsageError
from sagemp_cli.loop.controller import Controller
from sagemp_cli.sets.box import Box


@dataclass(frozen=True)
class ClosedLoop:
    """Dynamics, tracker and fixed references put together; ``step`` is the one-step map ``f(x, pi(e), w)``.

    Attributes:
        dynamics: the robot.
        tracker: the policy, ``u = pi(e)`` or another function of the state and the next points of the reference.
        references: ``(..., K+1, n)``; leading dimensions are batch and broadcast against those of the state.
    """

    dynamics: Dynamics
    tracker: Controller
    references: Tensor

    def __post_init__(self) -> None:
        n = self.dynamics.state_dim
        if self.references.dim() < 2 or self.references.shape[-1] != n or self.references.shape[-2] < 2:
            raise UsageError(
                f"references must have shape (..., K+1, {n}) with K >= 1, found {tuple(self.references.shape)}"
            )
        if not bool(torch.isfinite(self.references).all()):
            raise NonFiniteError("a reference contains NaN or infinity")
        if self.tracker.state_dim != n or self.tracker.control_dim != self.dynamics.control_dim:
            raise UsageError(
                f"tracker maps {self.tracker.state_dim} states to {self.tracker.control_dim} controls, "
                f"but the robot has {n} and {self.dynamics.control_dim}"
            )

    @property
    def horizon(self) -> int:
        """Number of steps K."""
        return self.references.shape[-2] - 1

    @property
    def state_dim(self) -> int:
        """Number of states n."""
        return self.dynamics.state_dim

    @property
    def period(self) -> float:
        """Seconds between two instants."""
        return self.dynamics.dt

    @property
    def continuous(self) -> bool:
        """Whether the robot is an ODE whose control is held between the instants."""
        return self.dynamics.continuous

    @property
    def lag(self) -> Box | None:
        """Bounds of the control's delay and its measurement's jitter, in seconds, ``(2,)``; None if there is none."""
        return self.dynamics.control_lag.box if self.dynamics.control_lag else None

    def rate(self, x: Tensor, u: Tensor) -> Tensor:
        """The undisturbed derivative of the state, ``f(x, u)``."""
        return self.dynamics.derivative(x, u)

    def window(self, k: int) -> Tensor:
        """The lookahead ``p_{k+1}..p_{k+N}``, padded with ``p_K``, shape ``(..., N, n)``."""
        index = torch.arange(k + 1, k + 1 + self.tracker.lookahead).clamp(max=self.horizon)
        return self.references[..., index, :]

    def control(self, k: int, x: Tensor) -> Tensor:
        """``u_k``; of the paper's tracker ``pi(e_k)``, ``e_k = [p_{k+1} - x_k, ..., p_{k+N} - x_k]`` (equation 6)."""
        return self.tracker.control(self.window(k), x)

    def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
        """``x_{k+1}`` from ``x_k (..., n)`` and ``w_k (..., n)``."""
        return self.after(x, self.control(k, x), w)

    def after(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        """The next state ``(..., n)`` under a control ``(..., m)``."""
        return self.dynamics.step(x, u, w)

    def numbers(self) -> Tensor:
        """What each step has of its own, its window row by row, ``(K, ..., N n)``."""
        steps = torch.arange(1, self.horizon + 1)
        index = (steps[:, None] + torch.arange(self.tracker.lookahead)).clamp(max=self.horizon)
        return self.references[..., index, :].movedim(-3, 0).flatten(-2)

    def step_given(self, numbers: Tensor, x: Tensor, w: Tensor) -> tuple[Tensor, ...]:
        """The next state and the control ``u_k``, from the step's :meth:`numbers`."""
        u = self.control_given(numbers, x)
        return self.after(x, u, w), u

    def control_given(self, numbers: Tensor, x: Tensor) -> Tensor:
        """``u_k``, from the step's :meth:`numbers`."""
        return self.tracker.control(numbers.unflatten(-1, (self.tracker.lookahead, self.state_dim)), x)

    def rollout(self, x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
        """Algorithm 1: states ``(..., K+1, n)`` and controls ``(..., K, m)`` from starts and disturbances.

        Args:
            x: starts ``(..., n)``.
            w: disturbances ``(..., K, n)``; fewer rows give a shorter rollout. Of a control that lags with two columns
                more, see :meth:`~sagemp_cli.dynamics.base.Dynamics.unknowns`; without them it lags as little as it may.
        """
        states, controls, dynamics = [x], [], self.dynamics
        lags, w = bool(dynamics.control_lag), dynamics.completed(w)
        for k in range(w.shape[-2]):
            now = w[..., k, :]
            if not lags:
                controls.append(self.control(k, states[-1]))
                states.append(self.after(states[-1], controls[-1], now))
                continue
            measured = states[-1]
            if k:
                before = torch.cat([w[..., k - 1, :-2], now[..., -2:]], dim=-1)
                measured = dynamics.measured(states[-1], controls[-1], before)
            controls.append(self.control(k, measured))
            held = controls[max(k - 1, 0)]  # the first control is there at once
            states.append(dynamics.lagged(states[-1], held, controls[-1], now))
        return torch.stack(states, dim=-2), torch.stack(controls, dim=-2)
