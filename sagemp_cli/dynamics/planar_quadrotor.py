"""The planar quadrotor of the paper's appendix: six states, two controls."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.dynamics.flatness import Array, planar_tilt


class PlanarQuadrotor(Dynamics):
    """``x = [px, pz, phi, vx, vz, omega]``, ``u = [thrust, torque]``.

    ``vx' = -(u1/m) sin(phi), vz' = g + (u1/m) cos(phi), omega' = u2 / I_y`` with the paper's ``m = 0.5 kg``,
    ``g = -9.81 m/s^2`` and ``I_y = 0.01 kg m^2`` as defaults; ``common`` are the arguments of every robot.
    """

    state_names = ("px", "pz", "phi", "vx", "vz", "omega")
    state_units = ("m", "m", "rad", "m/s", "m/s", "rad/s")
    control_names = ("thrust", "torque")
    control_units = ("N", "N m")
    position = (0, 1)
    angles = ("phi",)
    rates = MappingProxyType({"vx": "px", "vz": "pz", "omega": "phi"})

    def __init__(
        self,
        *,
        mass: float = 0.5,
        gravity: float = -9.81,
        inertia: float = 0.01,
        **common: Any,
    ) -> None:
        super().__init__(**common)
        self.mass, self.gravity, self.inertia = float(mass), float(gravity), float(inertia)

    def filled_in(self, known: Mapping[str, Array]) -> Iterator[tuple[str, Array, str]]:
        """The tilt, see :class:`~sagemp_cli.dynamics.base.Dynamics`."""
        yield "phi", planar_tilt(known["vx"], known["vz"], self.dt), "tilt from the differences of the velocity"

    def derivative(self, x: Tensor, u: Tensor) -> Tensor:
        """The undisturbed state derivative, see :class:`~sagemp_cli.dynamics.base.Dynamics`."""
        phi, lift = x[..., 2], u[..., 0:1] / self.mass
        push = lift * torch.stack([torch.sin(phi), torch.cos(phi)], dim=-1)
        return torch.stack(
            [
                x[..., 3],
                x[..., 4],
                x[..., 5],
                -push[..., 0],
                self.gravity + push[..., 1],
                u[..., 1] / self.inertia,
            ],
            dim=-1,
        )
