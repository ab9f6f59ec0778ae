"""A quadrotor that climbs to a height of one.

The published file has slips in the body accelerations; taken are those of the rigid body, as in the papers that the
benchmark is from: ``x4' = x12 x5 - x11 x6 - g sin x8`` and ``x5' = x10 x6 - x12 x4 + g cos x8 sin x7``.
"""

import torch

from sagemp_cli.scenes.requirements import Inside

GRAVITY, MASS, INERTIA_X, INERTIA_Y, INERTIA_Z = 9.81, 1.4, 0.054, 0.054, 0.104


class Quad:
    """Position, body velocity, roll, pitch, yaw, and body rates."""

    network = "QUAD__quad_controller_3_64_torch.onnx"
    period, horizon = 0.1, 50
    state_names = tuple(f"x{i}" for i in range(1, 13))
    start = ((-0.4, 0.4),) * 6 + ((0.0, 0.0),) * 6
    requirements = (Inside({"x3": (0.94, 1.06)}, when="end"),)

    def control(self, x, network):
        """Thrust beyond the weight, and two torques; there is none about the vertical."""
        return network(x)

    def rate(self, x, u):
        """The time derivative of the state."""
        _, _, _, vx, vy, vz, roll, pitch, yaw, p, q, r = x.unbind(-1)
        s7, c7, s8, c8, s9, c9 = (f(a) for a in (roll, pitch, yaw) for f in (torch.sin, torch.cos))
        return torch.stack(
            [
                c8 * c9 * vx + (s7 * s8 * c9 - c7 * s9) * vy + (c7 * s8 * c9 + s7 * s9) * vz,
                c8 * s9 * vx + (s7 * s8 * s9 + c7 * c9) * vy + (c7 * s8 * s9 - s7 * c9) * vz,
                s8 * vx - s7 * c8 * vy - c7 * c8 * vz,
                r * vy - q * vz - GRAVITY * s8,
                p * vz - r * vx + GRAVITY * c8 * s7,
                q * vx - p * vy + GRAVITY * c8 * c7 - GRAVITY - u[..., 0] / MASS,
                p + s7 * torch.tan(pitch) * q + c7 * torch.tan(pitch) * r,
                c7 * q - s7 * r,
                (s7 * q + c7 * r) / c8,
                (INERTIA_Y - INERTIA_Z) / INERTIA_X * q * r + u[..., 1] / INERTIA_X,
                (INERTIA_Z - INERTIA_X) / INERTIA_Y * p * r + u[..., 2] / INERTIA_Y,
                0.0 * r,
            ],
            -1,
        )
