"""The unicycle whose speed is a control (LaValle 2006, equation 13.18): three states, two controls."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor

from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.dynamics.flatness import Array, heading


class KinematicUnicycle(Dynamics):
    """``x = [px, py, theta]``, ``u = [v, turn rate]``.

    ``px' = v cos(theta), py' = v sin(theta), theta' = turn rate``: a differential-drive robot whose wheels follow
    their commands at once. The paper's tables list three entries for its VLM case, so this is the reading there;
    where they list four it is :class:`~sagemp_cli.dynamics.unicycle.Unicycle`.
    """

    state_names = ("px", "py", "theta")
    state_units = ("m", "m", "rad")
    control_names = ("v", "turn_rate")
    control_units = ("m/s", "rad/s")
    position = (0, 1)
    angles = ("theta",)

    def filled_in(self, known: Mapping[str, Array]) -> Iterator[tuple[str, Array, str]]:
        """The heading, see :class:`~sagemp_cli.dynamics.base.Dynamics`."""
        yield "theta", heading(known["px"], known["py"], self.dt), "direction of the position's differences"

    def derivative(self, x: Tensor, u: Tensor) -> Tensor:
        """The undisturbed state derivative, see :class:`~sagemp_cli.dynamics.base.Dynamics`."""
        theta, v = x[..., 2], u[..., 0]
        return torch.stack([v * torch.cos(theta), v * torch.sin(theta), u[..., 1]], dim=-1)
