"""Attitudes that follow from a flight, against the robot that flies it."""

import numpy as np
import torch

from sagemp_cli.dynamics.flatness import tilt
from sagemp_cli.dynamics.quadrotor import Quadrotor


def test_pitch_and_roll_are_those_that_push_the_robot_at_any_yaw():
    rng, count, dt = np.random.default_rng(0), 60, 0.05
    wide = {"lower": [-100.0] * 12, "upper": [100.0] * 12}
    robot = Quadrotor(dt=dt, state_lower=wide["lower"], state_upper=wide["upper"],
                      control_lower=[-100.0] * 4, control_upper=[100.0] * 4)  # fmt: skip
    x = np.zeros((count, 12))
    x[:, 3:6] = rng.uniform([-3.0, -0.5, -0.5], [3.0, 0.5, 0.5], size=(count, 3))
    u = np.zeros((count, 4))
    u[:, 0] = rng.uniform(5.0, 15.0, size=count)
    pushed = robot.derivative(torch.from_numpy(x), torch.from_numpy(u)).numpy()[:, 6:9]
    velocity = np.cumsum(np.vstack([np.zeros(3), dt * pushed]), axis=0).T
    theta, phi = tilt(*velocity, np.append(x[:, 3], 0.0), dt)
    np.testing.assert_allclose(theta[:-1], x[:, 4], atol=1e-9)
    np.testing.assert_allclose(phi[:-1], x[:, 5], atol=1e-9)
