"""A cart on a spring, steadied by a rotating arm."""

import torch

from sagemp_cli.scenes.requirements import Inside


class Tora:
    """Position and velocity of the cart, angle and rate of the arm."""

    network = "Benchmark9-Tora__controllerTora.onnx"
    period, horizon = 1.0, 20
    state_names = ("x1", "x2", "x3", "x4")
    start = ((0.6, 0.7), (-0.7, -0.6), (-0.4, -0.3), (0.5, 0.6))
    requirements = (Inside({name: (-2.0, 2.0) for name in state_names}),)

    def control(self, x, network):
        """The arm's angular acceleration."""
        return network(x) - 10

    def rate(self, x, u):
        """The time derivative of the state."""
        position, velocity, angle, rate = x.unbind(-1)
        return torch.stack([velocity, 0.1 * torch.sin(angle) - position, rate, u[..., 0]], -1)
