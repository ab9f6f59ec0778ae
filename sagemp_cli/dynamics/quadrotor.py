"""The 3-D quadrotor of the paper's appendix: twelve states, four controls (Sabatino 2015, corrected rows)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.errors import ConfigError


class Quadrotor(Dynamics):
    """``x = [px, py, pz, psi, theta, phi, vx, vy, vz, p, q, r]`` (yaw, pitch, roll), ``u = [thrust, 3 torques]``.

    Accelerations are ``u1/m`` times the third column of ``R_z(psi) R_y(theta) R_x(phi)`` plus gravity. The paper's
    rows for ``pz'`` and ``vy'`` slip; these are the corrected ones: ``pz' = vz`` and
    ``vy' = u1/m (cos(phi) sin(psi) sin(theta) - sin(phi) cos(psi))``.
    """

    state_names = ("px", "py", "pz", "psi", "theta", "phi", "vx", "vy", "vz", "p", "q", "r")
    state_units = ("m", "m", "m", "rad", "rad", "rad", "m/s", "m/s", "m/s", "rad/s", "rad/s", "rad/s")
    control_names = ("thrust", "torque_x", "torque_y", "torque_z")
    control_units = ("N", "N m", "N m", "N m")
    position = (0, 1, 2)

    def __init__(
        self,
        *,
        dt: float,
        control_lower: list[float],
        control_upper: list[float],
        state_lower: list[float],
        state_upper: list[float],
        disturbance: str = "derivative",
        mass: float = 1.0,
        gravity: float = -9.81,
        inertia: Sequence[float] = (0.5, 0.1, 0.3),
    ) -> None:
        super().__init__(
            dt=dt,
            control_lower=control_lower,
            control_upper=control_upper,
            state_lower=state_lower,
            state_upper=state_upper,
            disturbance=disturbance,
        )
        if len(inertia) != 3:
            raise ConfigError(f"Quadrotor: inertia needs 3 numbers, found {len(inertia)}")
        self.mass, self.gravity = float(mass), float(gravity)
        self.inertia = tuple(float(i) for i in inertia)

    def derivative(self, x: Tensor, u: Tensor) -> Tensor:
        """The undisturbed state derivative, see :class:`~sagemp_cli.dynamics.base.Dynamics`."""
        psi, theta, phi = x[..., 3], x[..., 4], x[..., 5]
        p, q, r = x[..., 9], x[..., 10], x[..., 11]
        sin_psi, cos_psi = torch.sin(psi), torch.cos(psi)
        sin_theta, cos_theta = torch.sin(theta), torch.cos(theta)
        sin_phi, cos_phi = torch.sin(phi), torch.cos(phi)
        turn = (q * sin_phi + r * cos_phi) / cos_theta
        lift = u[..., 0] / self.mass
        tilt = cos_phi * sin_theta
        i_x, i_y, i_z = self.inertia
        return torch.stack(
            [
                x[..., 6],
                x[..., 7],
                x[..., 8],
                turn,
                q * cos_phi - r * sin_phi,
                p + turn * sin_theta,
                lift * (sin_phi * sin_psi + tilt * cos_psi),
                lift * (tilt * sin_psi - sin_phi * cos_psi),
                self.gravity + lift * (cos_phi * cos_theta),
                (i_y - i_z) / i_x * (q * r) + u[..., 1] / i_x,
                (i_z - i_x) / i_y * (p * r) + u[..., 2] / i_y,
                (i_x - i_y) / i_z * (p * q) + u[..., 3] / i_z,
            ],
            dim=-1,
        )
