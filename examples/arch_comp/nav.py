"""A robot that drives past an obstacle to the origin, with the network that was trained on sets."""

import torch

from sagemp_cli.scenes.requirements import Inside, Outside


class Nav:
    """Position, speed and heading."""

    network = "NAV__nn-nav-set.onnx"
    period, horizon = 0.2, 30
    state_names = ("x1", "x2", "x3", "x4")
    start = ((2.9, 3.1), (2.9, 3.1), (0.0, 0.0), (0.0, 0.0))
    requirements = (
        Outside({"x1": (1.0, 2.0), "x2": (1.0, 2.0)}),
        Inside({"x1": (-0.5, 0.5), "x2": (-0.5, 0.5)}, when="end"),
    )

    def control(self, x, network):
        """Acceleration and turn rate."""
        return network(x)

    def rate(self, x, u):
        """The time derivative of the state."""
        _, _, speed, heading = x.unbind(-1)
        return torch.stack([speed * torch.cos(heading), speed * torch.sin(heading), u[..., 0], u[..., 1]], -1)
