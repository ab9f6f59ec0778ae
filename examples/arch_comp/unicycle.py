"""A car that drives to the origin, with a disturbed speed."""

import torch

from sagemp_cli.scenes.requirements import Inside


class Unicycle:
    """Position, heading and speed."""

    network = "Benchmark10-Unicycle__controllerB.onnx"
    period, horizon = 0.2, 50
    state_names = ("x1", "x2", "x3", "x4")
    start = ((9.5, 9.55), (-4.5, -4.45), (2.1, 2.11), (1.5, 1.51))
    disturbance = ((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (-1e-4, 1e-4))
    requirements = (Inside({"x1": (-0.6, 0.6), "x2": (-0.2, 0.2), "x3": (-0.06, 0.06), "x4": (-0.3, 0.3)}, when="end"),)

    def control(self, x, network):
        """Acceleration and turn rate."""
        return network(x) - 20

    def rate(self, x, u):
        """The time derivative of the state."""
        _, _, heading, speed = x.unbind(-1)
        return torch.stack([speed * torch.cos(heading), speed * torch.sin(heading), u[..., 1], u[..., 0]], -1)
