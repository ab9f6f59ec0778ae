"""A robot, a scene and a start as a chain of nodes that :mod:`sagemp_cli.experts.interior_point` can optimise.

Direct transcription: states and controls of every step are unknowns, tied by the true discrete dynamics
``x_{k+1} = f(x_k, u_k, 0)``. All derivatives are exact, by automatic differentiation of all steps at once, so any
:class:`~sagemp_cli.dynamics.base.Dynamics` can be optimised as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sagemp_cli.config.ranges import NonNegative, Positive
from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.errors import ConfigError
from sagemp_cli.experts.derivatives import row_jacobians
from sagemp_cli.scenes import Scene

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Weights:
    """What an expert minimises, every weight per control or per state, none negative.

    ``J = sum_k dt effort |u_k - rest|^2 + sum_k smoothness |u_{k+1} - u_k|^2 / dt + goal |x_K - centre|^2``, the
    last over the goal's bounded dimensions only.

    Attributes:
        effort: weights of the controls ``(m,)``, positive.
        smoothness: weights of the controls' rate of change ``(m,)``.
        goal: weights of the distance to the goal box's centre at the end ``(n,)``.
        rest: controls that cost no effort ``(m,)``, a flying robot's hover thrust; zero when not given.
    """

    effort: Sequence[Positive]
    smoothness: Sequence[NonNegative]
    goal: Sequence[NonNegative]
    rest: Sequence[float] | None = None


class Transcription:
    """``min J  s.t.  dynamics, limits, clearance, goal`` as a chain problem.

    Constrained at steps 1..K (the start is what it is): state limits, the workspace shrunken by
    ``workspace_margin``, a distance of at least ``margin`` to each obstacle; at step K the goal box; at steps
    0..K-1 the control limits. Between two steps nothing is checked: choose the margin above the gap that a chord
    of one step can cut off.

    Args:
        dynamics: the robot.
        scene: workspace, obstacles and goal box.
        start: ``x_0 (n,)``.
        horizon: number of steps K.
        weights: the cost.
        margin: metres between the robot's position and every obstacle.
        workspace_margin: metres between the robot's position and the workspace's walls.

    Raises:
        ConfigError: a start or weight list of the wrong length, a negative weight, a goal without a place, or margins
            that leave no room.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        scene: Scene,
        *,
        start: Array,
        horizon: int,
        weights: Weights,
        margin: float,
        workspace_margin: float = 0.0,
    ) -> None:
        self.dynamics, self.scene, self.horizon = dynamics, scene, horizon
        self.start = np.asarray(start, dtype=np.float64)
        self.margin, self.workspace_margin = float(margin), float(workspace_margin)
        self.state_dim, self.control_dim = dynamics.state_dim, dynamics.control_dim
        n, m, dt = self.state_dim, self.control_dim, dynamics.dt
        if self.start.shape != (n,):
            raise ConfigError(f"the start needs {n} numbers, found shape {self.start.shape}")
        if horizon < 2:
            raise ConfigError(f"horizon must be at least 2 steps, found {horizon}")
        rest = [0.0] * m if weights.rest is None else weights.rest
        for key, values, size in (
            ("effort", weights.effort, m),
            ("smoothness", weights.smoothness, m),
            ("goal", weights.goal, n),
            ("rest", rest, m),
        ):
            if len(values) != size:
                raise ConfigError(f"weights.{key} needs {size} numbers, found {len(values)}")
            if key != "rest" and min(values) < (1e-9 if key == "effort" else 0.0):
                wanted = "positive" if key == "effort" else "not negative"
                raise ConfigError(f"weights.{key} must be {wanted}, found {list(values)}")

        self.lower, self.upper = np.full((horizon + 1, n + m), -np.inf), np.full((horizon + 1, n + m), np.inf)
        self.lower[1:, :n], self.upper[1:, :n] = dynamics.state_lower.numpy(), dynamics.state_upper.numpy()
        place = list(dynamics.position)
        inner_low = scene.workspace.lower.numpy() + self.workspace_margin
        inner_high = scene.workspace.upper.numpy() - self.workspace_margin
        self.lower[1:, place] = np.maximum(self.lower[1:, place], inner_low)
        self.upper[1:, place] = np.minimum(self.upper[1:, place], inner_high)
        goal_low, goal_high = scene.goal.lower.numpy(), scene.goal.upper.numpy()
        self.lower[-1, :n] = np.maximum(self.lower[-1, :n], goal_low)
        self.upper[-1, :n] = np.minimum(self.upper[-1, :n], goal_high)
        self.lower[:-1, n:], self.upper[:-1, n:] = dynamics.control_lower.numpy(), dynamics.control_upper.numpy()
        if (self.lower >= self.upper).any():
            raise ConfigError(
                "no room is left inside the state limits: the workspace shrunken by workspace_margin "
                f"{self.workspace_margin} and the goal box must overlap them"
            )

        obstacles = np.zeros((horizon + 1, len(scene.obstacles)), dtype=bool)
        obstacles[1:] = True
        self.active = np.concatenate([np.isfinite(self.lower), np.isfinite(self.upper), obstacles], axis=1)

        bounded = np.isfinite(goal_low) & np.isfinite(goal_high)
        self.goal_center = np.full(n, np.nan)
        """Centre of the goal box ``(n,)``, NaN in dimensions without a bound."""
        self.goal_center[bounded] = 0.5 * goal_low[bounded] + 0.5 * goal_high[bounded]
        if np.isnan(self.goal_center[place]).any():
            raise ConfigError("the goal box must bound the position; only other states may be infinite")
        self._aim = np.zeros((horizon + 1, n + m))
        self._aim[-1, :n] = np.where(bounded, self.goal_center, 0.0)
        self._aim[:-1, n:] = rest
        self._weight = np.zeros((horizon + 1, n + m))
        self._weight[-1, :n] = np.where(bounded, weights.goal, 0.0)
        self._weight[:-1, n:] = dt * np.asarray(weights.effort)
        self._rate = np.asarray(weights.smoothness, dtype=np.float64) / dt

    def cost(self, z: Array) -> float:
        """J of a chain ``(K+1, n+m)``."""
        rates = np.diff(z[:-1, self.state_dim :], axis=0)
        return float((self._weight * (z - self._aim) ** 2).sum() + (self._rate * rates**2).sum())

    def cost_gradient(self, z: Array) -> Array:
        """Gradient of J, ``(K+1, n+m)``."""
        gradient = 2.0 * self._weight * (z - self._aim)
        pull = 2.0 * self._rate * np.diff(z[:-1, self.state_dim :], axis=0)
        gradient[1:-1, self.state_dim :] += pull
        gradient[:-2, self.state_dim :] -= pull
        return gradient

    def cost_curvature(self) -> tuple[Array, Array]:
        """Hessian of J: diagonals ``(K+1, n+m)`` and the coupling ``(K, m)`` of ``u_k`` with ``u_{k+1}``."""
        diagonal = 2.0 * self._weight
        diagonal[1:-1, self.state_dim :] += 2.0 * self._rate
        diagonal[:-2, self.state_dim :] += 2.0 * self._rate
        coupling = np.zeros((self.horizon, self.control_dim))
        coupling[:-1] = -2.0 * self._rate
        return diagonal, coupling

    def constraints(self, z: Array) -> tuple[Array, Array]:
        """Defects ``(K+1, n)`` and inequalities ``(K+1, c)``: above lower, below upper limits, clear of obstacles."""
        nodes = torch.from_numpy(z)
        following = self._step(nodes[:-1]).numpy()
        defects = np.concatenate([self.start[None], following]) - z[:, : self.state_dim]
        inequalities = np.concatenate([z - self.lower, self.upper - z, self._clearance(nodes).numpy()], axis=1)
        return defects, inequalities

    def jacobians(self, z: Array) -> tuple[Array, Array]:
        """``df/dz (K, n, n+m)`` and the inequalities' Jacobian ``(K+1, c, n+m)``."""
        nodes, width = torch.from_numpy(z), z.shape[1]
        jacobian = np.zeros((z.shape[0], self.active.shape[1], width))
        index = np.arange(width)
        jacobian[:, index, index] = 1.0
        jacobian[:, width + index, index] = -1.0
        if self.scene.obstacles:
            jacobian[:, 2 * width :] = row_jacobians(self._clearance, nodes, outputs=len(self.scene.obstacles)).numpy()
        dynamics_jacobian = row_jacobians(self._step, nodes[:-1], outputs=self.state_dim).numpy()
        return dynamics_jacobian, jacobian

    def rollout(self, controls: Array) -> Array:
        """States ``(K+1, n)`` from the start under controls ``(K, m)`` and no disturbance, step by step."""
        x, w = torch.from_numpy(self.start), torch.zeros(self.state_dim, dtype=torch.float64)
        states = [x]
        for u in torch.from_numpy(controls):
            states.append(self.dynamics.step(states[-1], u, w))
        return torch.stack(states).numpy()

    def _step(self, node: Tensor) -> Tensor:
        x, u = node[..., : self.state_dim], node[..., self.state_dim :]
        return self.dynamics.step(x, u, torch.zeros_like(x))

    def _clearance(self, node: Tensor) -> Tensor:
        place = node[..., list(self.dynamics.position)]
        distances = [obstacle.signed_distance(place) - self.margin for obstacle in self.scene.obstacles]
        return torch.stack(distances, dim=-1) if distances else place[..., :0]
