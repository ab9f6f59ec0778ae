"""The unicycle with speed as a state (LaValle 2006, equation 13.18, extended by acceleration)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor

from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.dynamics.flatness import Array, heading, speed


class Unicycle(Dynamics):
    """``x = [px, py, theta, v]``, ``u = [turn rate, acceleration]``.

    ``px' = v cos(theta), py' = v sin(theta), theta' = turn rate, v' = acceleration``. The paper cites an
    equation with three states but lists four entries in its tables; this is the four-state reading.
    """

    state_names = ("px", "py", "theta", "v")
    state_units = ("m", "m", "rad", "m/s")
    control_names = ("turn_rate", "acceleration")
    control_units = ("rad/s", "m/s^2")
    position = (0, 1)
    angles = ("theta",)

    def filled_in(self, known: Mapping[str, Array]) -> Iterator[tuple[str, Array, str]]:
        """Speed and heading, see :class:`~sagemp_cli.dynamics.base.Dynamics`."""
        yield "v", speed(known["px"], known["py"], self.dt), "speed of the position's differences"
        yield "theta", heading(known["px"], known["py"], self.dt), "direction of the position's differences"

    def derivative(self, x: Tensor, u: Tensor) -> Tensor:
        """The undisturbed state derivative, see :class:`~sagemp_cli.dynamics.base.Dynamics`."""
        theta, v = x[..., 2], x[..., 3:4]
        heading = torch.stack([torch.cos(theta), torch.sin(theta)], dim=-1)
        return torch.cat([v * heading, u], dim=-1)
