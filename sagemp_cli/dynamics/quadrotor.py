"""The 3-D quadrotor of the paper's appendix: twelve states, four controls (Sabatino 2015, corrected rows)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.dynamics.flatness import Array, tilt
from sagemp_cli.errors import ConfigError


class Quadrotor(Dynamics):
    """``x = [px, py, pz, psi, theta, phi, vx, vy, vz, p, q, r]`` (yaw, pitch, roll), ``u = [thrust, 3 torques]``.

    Accelerations are ``u1/m`` times the third column of ``R_z(psi) R_y(theta) R_x(phi)`` plus gravity. The paper's
    rows for ``pz'`` and ``vy'`` slip; these are the corrected ones: ``pz' = vz`` and
    ``vy' = u1/m (cos(phi) sin(psi) sin(theta) - sin(phi) cos(psi))``.

    Args:
        mass: kg.
        gravity: m/s^2, negative.
        inertia: about the body's axes x, y, z, kg m^2.
        common: those of every robot.
    """

    state_names = ("px", "py", "pz", "psi", "theta", "phi", "vx", "vy", "vz", "p", "q", "r")
    state_units = ("m", "m", "m", "rad", "rad", "rad", "m/s", "m/s", "m/s", "rad/s", "rad/s", "rad/s")
    control_names = ("thrust", "torque_x", "torque_y", "torque_z")
    control_units = ("N", "N m", "N m", "N m")
    position = (0, 1, 2)
    angles = ("psi", "theta", "phi")
    # body rates are the angles' only where tilts are small
    rates = MappingProxyType({"vx": "px", "vy": "py", "vz": "pz", "p": "phi", "q": "theta", "r": "psi"})

    def __init__(
        self,
        *,
        mass: float = 1.0,
        gravity: float = -9.81,
        inertia: Sequence[float] = (0.5, 0.1, 0.3),
        **common: Any,
    ) -> None:
        super().__init__(**common)
        if len(inertia) != 3:
            raise ConfigError(f"Quadrotor: inertia needs 3 numbers, found {len(inertia)}")
        self.mass, self.gravity = float(mass), float(gravity)
        self.inertia = tuple(float(i) for i in inertia)

    def filled_in(self, known: Mapping[str, Array]) -> Iterator[tuple[str, Array, str]]:
        """The attitude, see :class:`~sagemp_cli.dynamics.base.Dynamics`."""
        yield "psi", np.zeros_like(known["pz"]), "taken as 0"
        theta, phi = tilt(known["vx"], known["vy"], known["vz"], known["psi"], self.dt)
        yield "theta", theta, "tilt from the differences of the velocity"
        yield "phi", phi, "tilt from the differences of the velocity"

    def derivative(self, x: Tensor, u: Tensor) -> Tensor:
        """The undisturbed state derivative, see :class:`~sagemp_cli.dynamics.base.Dynamics`."""
        p, q, r = (x[..., i] for i in (9, 10, 11))
        sin, cos = torch.sin(x[..., 3:6]), torch.cos(x[..., 3:6])
        sin_psi, sin_theta, sin_phi = (sin[..., i] for i in range(3))
        cos_psi, cos_theta, cos_phi = (cos[..., i] for i in range(3))
        q_sin, r_cos, q_cos, r_sin, q_r, p_r, p_q, tilt, across, along, upright = _products(
            *((q, sin_phi), (r, cos_phi), (q, cos_phi), (r, sin_phi), (q, r), (p, r), (p, q)),
            *((cos_phi, sin_theta), (sin_phi, sin_psi), (sin_phi, cos_psi), (cos_phi, cos_theta)),
        )
        turn = (q_sin + r_cos) / cos_theta
        lift = u[..., 0] / self.mass
        tilt_cos, tilt_sin, turn_sin = _products((tilt, cos_psi), (tilt, sin_psi), (turn, sin_theta))
        push_x, push_y, push_z = _products((lift, across + tilt_cos), (lift, tilt_sin - along), (lift, upright))
        i_x, i_y, i_z = self.inertia
        return torch.stack(
            [
                x[..., 6],
                x[..., 7],
                x[..., 8],
                turn,
                q_cos - r_sin,
                p + turn_sin,
                push_x,
                push_y,
                self.gravity + push_z,
                (i_y - i_z) / i_x * q_r + u[..., 1] / i_x,
                (i_z - i_x) / i_y * p_r + u[..., 2] / i_y,
                (i_x - i_y) / i_z * p_q + u[..., 3] / i_z,
            ],
            dim=-1,
        )


def _products(*pairs: tuple[Tensor, Tensor]) -> list[Tensor]:
    """The product of each pair, all in one operation: for a set of states many cost hardly more than one."""
    left, right = (torch.stack(factors, dim=-1) for factors in zip(*pairs, strict=True))
    products = left * right
    return [products[..., i] for i in range(len(pairs))]
