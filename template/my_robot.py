"""A differential-drive robot whose motors lag behind what they are told, and a planner of its own."""

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor

from sagemp_cli.dynamics import Dynamics
from sagemp_cli.dynamics.flatness import Array, heading, speed
from sagemp_cli.plugins import planner, robot


@robot("my_robot")
class MyRobot(Dynamics):
    """``x = [px, py, theta, v, omega]``, ``u = [v_command, omega_command]``; speeds follow commands with a lag."""

    state_names = ("px", "py", "theta", "v", "omega")
    state_units = ("m", "m", "rad", "m/s", "rad/s")
    control_names = ("v_command", "omega_command")
    control_units = ("m/s", "rad/s")
    position = (0, 1)  # which states are the place in the scene

    # So that a plan may leave out what follows from its positions:
    angles = ("theta",)
    rates = {"omega": "theta"}

    def __init__(self, *, lag: float, **common) -> None:
        super().__init__(**common)  # dt, limits, how w enters: see conf/dynamics/my_robot.yaml
        self.lag = lag

    def derivative(self, x: Tensor, u: Tensor) -> Tensor:
        """The one place where the robot's motion is written: simulated, trained through, bounded and checked."""
        theta, v, omega = x[..., 2], x[..., 3], x[..., 4]
        return torch.stack(
            [
                v * torch.cos(theta),
                v * torch.sin(theta),
                omega,
                (u[..., 0] - v) / self.lag,
                (u[..., 1] - omega) / self.lag,
            ],
            dim=-1,
        )

    def filled_in(self, known: Mapping[str, Array]) -> Iterator[tuple[str, Array, str]]:
        """Speed and heading of a plan that only has positions."""
        yield "v", speed(known["px"], known["py"], self.dt), "speed of the position's differences"
        yield "theta", heading(known["px"], known["py"], self.dt), "direction of the position's differences"


@planner("detour")
def detour(start, goal, scene, count, generator, *, horizon: int, dt: float, widest: float = 0.2) -> Tensor:
    """Plans ``(count, K+1, 5)`` past the pillar to the goal's middle, a little different each time."""
    share = torch.linspace(0, 1, horizon + 1, dtype=torch.float64)
    height = 1.0 + widest * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    length = (goal.lower[0] + goal.upper[0]) / 2 - start[:, :1]
    px = start[:, :1] + length * share
    py = start[:, 1:2] + height * torch.sin(torch.pi * share) ** 2
    vx, vy = torch.gradient(px, dim=1)[0] / dt, torch.gradient(py, dim=1)[0] / dt
    theta, v = torch.atan2(vy, vx), torch.hypot(vx, vy)
    omega = torch.gradient(theta, dim=1)[0] / dt
    plans = torch.stack([px, py, theta, v, omega], dim=-1)
    plans[:, 0] = start  # row 0 of a plan is the start that was asked for
    return plans
