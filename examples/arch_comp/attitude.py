"""A rigid body that turns, its attitude in modified Rodrigues parameters."""

import torch

from sagemp_cli.scenes.requirements import Outside


class Attitude:
    """Three rates and three Rodrigues parameters."""

    network = "Attitude-Control__attitude_control_3_64_torch.onnx"
    period, horizon = 0.1, 30
    state_names = ("x1", "x2", "x3", "x4", "x5", "x6")
    start = ((-0.45, -0.44), (-0.55, -0.54), (0.65, 0.66), (-0.75, -0.74), (0.85, 0.86), (-0.65, -0.64))
    requirements = (
        Outside(
            {
                "x1": (-0.2, 0.0),
                "x2": (-0.5, -0.4),
                "x3": (0.0, 0.2),
                "x4": (-0.7, -0.6),
                "x5": (0.7, 0.8),
                "x6": (-0.4, -0.2),
            }
        ),
    )

    def control(self, x, network):
        """Three torques."""
        return network(x)

    def rate(self, x, u):
        """The time derivative of the state."""
        a, b, c, p, q, r = x.unbind(-1)
        n = p**2 + q**2 + r**2
        return torch.stack(
            [
                0.25 * (u[..., 0] + b * c),
                0.5 * (u[..., 1] - 3 * a * c),
                u[..., 2] + 2 * a * b,
                0.5 * (b * (n - r) + c * (n + q) + a * (n + 1)),
                0.5 * (a * (n + r) + c * (n - p) + b * (n + 1)),
                0.5 * (a * (n - q) + b * (n + p) + c * (n + 1)),
            ],
            -1,
        )
