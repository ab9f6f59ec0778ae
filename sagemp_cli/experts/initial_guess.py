"""States and controls that fit a path of positions as well as the robot can, for any dynamics."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.experts.derivatives import row_jacobians

Array = NDArray[np.float64]


def fill_path(dynamics: Dynamics, path: Array, *, start: Array, goal: Array) -> Array:
    """Nodes ``(K+1, n+m)`` whose positions are the path's and whose other entries suit it.

    First the states other than the position: the ones nearest to the straight line from the start's to the goal's
    under which the position's derivative is the path's velocity (heading and speed of a unicycle, velocities of a
    quadrotor). Then the controls whose Euler step comes nearest to the next state (acceleration, hover thrust). Both
    are damped least squares, all steps at once, and clipped to the limits. Nothing here is exactly feasible.

    Args:
        dynamics: the robot.
        path: positions ``(K+1, d)``.
        start: ``x_0 (n,)``.
        goal: the state to end at ``(n,)``; NaN where it does not matter, and the start's value is kept.
    """
    n, m, place = dynamics.state_dim, dynamics.control_dim, list(dynamics.position)
    end = np.where(np.isnan(goal), start, goal)
    share = np.linspace(0.0, 1.0, len(path))[:, None]
    states = torch.from_numpy((1.0 - share) * start + share * end)
    states[:, place] = torch.from_numpy(path)
    velocity = torch.from_numpy(np.gradient(path, dynamics.dt, axis=0))
    middle = 0.5 * (dynamics.control_lower + dynamics.control_upper)
    rest = torch.where(torch.isfinite(middle), middle, torch.zeros_like(middle)).expand(len(path), m)

    others = [i for i in range(n) if i not in place]
    if others:
        known = states.clone()

        def mismatch(free: Tensor) -> Tensor:
            x = known.expand(*free.shape[:-2], *known.shape).index_copy(-1, torch.tensor(others), free)
            return dynamics.derivative(x, rest.expand(*x.shape[:-1], m))[..., place] - velocity

        filled = _fit(mismatch, states[:, others], outputs=len(place))
        states[:, others] = filled.clamp(dynamics.state_lower[others], dynamics.state_upper[others])
    states[0] = torch.from_numpy(start)

    def defect(u: Tensor) -> Tensor:
        x = states[:-1].expand(*u.shape[:-1], n)
        return (dynamics.step(x, u, torch.zeros_like(x)) - states[1:]) / dynamics.dt

    controls = _fit(defect, rest[:-1], outputs=n).clamp(dynamics.control_lower, dynamics.control_upper)
    return torch.cat([states, torch.cat([controls, torch.zeros(1, m, dtype=torch.float64)])], dim=1).numpy()


def _fit(
    residual: Callable[[Tensor], Tensor], guess: Tensor, *, outputs: int, damping: float = 1e-3, steps: int = 5
) -> Tensor:
    """Gauss-Newton on ``|residual(v)|^2 + damping |v - guess|^2`` for every row of v."""
    value, eye = guess, damping * torch.eye(guess.shape[-1], dtype=guess.dtype)
    for _ in range(steps):
        jacobian = row_jacobians(residual, value, outputs=outputs)
        gradient = torch.einsum("kij,ki->kj", jacobian, residual(value)) + damping * (value - guess)
        value = value - torch.linalg.solve(jacobian.mT @ jacobian + eye, gradient)
    return value
