"""A spacecraft that approaches another one, the slower the nearer it is."""

import torch

from sagemp_cli.scenes.requirements import Holds

MEAN_MOTION, MASS = 0.001027, 12.0


def slow_enough(x):
    """What the speed is below ``0.2 + 2 n`` times the distance."""
    distance = torch.sqrt(x[..., 0:1] ** 2 + x[..., 1:2] ** 2)
    speed = torch.sqrt(x[..., 2:3] ** 2 + x[..., 3:4] ** 2)
    return 0.2 + 2 * MEAN_MOTION * distance - speed


class Docking:
    """Position and velocity in the orbital plane."""

    network = "Docking__model.onnx"
    period, horizon = 1.0, 40
    state_names = ("x1", "x2", "x3", "x4")
    start = ((70.0, 106.0), (70.0, 106.0), (-0.28, 0.28), (-0.28, 0.28))
    requirements = (Holds(slow_enough),)

    def control(self, x, network):
        """Two thrusts."""
        return network(x)

    def rate(self, x, u):
        """The time derivative of the state."""
        px, _, vx, vy = x.unbind(-1)
        n = MEAN_MOTION
        return torch.stack(
            [vx, x[..., 3], 2 * n * vy + 3 * n**2 * px + u[..., 0] / MASS, -2 * n * vx + u[..., 1] / MASS], -1
        )
