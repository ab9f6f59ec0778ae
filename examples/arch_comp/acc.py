"""A car that follows another one at a safe distance."""

import torch

from sagemp_cli.scenes.requirements import Holds


def safe_distance(x):
    """What the distance between the cars is more than ``10 + 1.4`` times the speed of the following one."""
    return x[..., 0:1] - x[..., 3:4] - 10 - 1.4 * x[..., 4:5]


class Acc:
    """Position, speed and acceleration of the car in front and of the one that follows."""

    network = "ACC__controller_5_20.onnx"
    period, horizon = 0.1, 50
    state_names = ("x1", "x2", "x3", "x4", "x5", "x6")
    start = ((90.0, 110.0), (32.0, 32.2), (0.0, 0.0), (10.0, 11.0), (30.0, 30.2), (0.0, 0.0))
    requirements = (Holds(safe_distance),)

    def control(self, x, network):
        """What the following car is to accelerate by."""
        front, front_speed, _, own, own_speed, _ = x.unbind(-1)
        told = 0 * own
        return network(torch.stack([told + 30, told + 1.4, own_speed, front - own, front_speed - own_speed], -1))

    def rate(self, x, u):
        """The time derivative of the state."""
        _, front_speed, front, _, own_speed, own = x.unbind(-1)
        return torch.stack(
            [
                front_speed,
                front,
                -2 * front - 4 - 1e-4 * front_speed**2,
                own_speed,
                own,
                -2 * own + 2 * u[..., 0] - 1e-4 * own_speed**2,
            ],
            -1,
        )
