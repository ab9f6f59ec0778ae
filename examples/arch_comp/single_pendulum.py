"""A pendulum that is to hang back after half a second."""

import torch

from sagemp_cli.scenes.requirements import Inside


class SinglePendulum:
    """Angle and rate."""

    network = "Single_Pendulum__controller_single_pendulum.onnx"
    period, horizon = 0.05, 20
    state_names = ("x1", "x2")
    start = ((1.0, 1.175), (0.0, 0.2))
    requirements = (Inside({"x1": (0.0, 1.0)}, when=(0.5, 1.0)),)

    def control(self, x, network):
        """The motor's torque."""
        return network(x)

    def rate(self, x, u):
        """The time derivative of the state."""
        return torch.stack([x[..., 1], 2 * torch.sin(x[..., 0]) + 8 * u[..., 0]], -1)
