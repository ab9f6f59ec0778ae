"""The planar quadrotor against Newton's law in vectors, and in hover."""

from __future__ import annotations

import numpy as np
import pytest
import torch


def test_the_accelerations_are_thrust_along_the_body_axis_plus_gravity(make_robot):
    robot = make_robot("planar_quadrotor")
    rng = np.random.default_rng(0)
    for _ in range(20):
        x, u = rng.normal(size=6), rng.normal(size=2)
        up = np.array([[np.cos(x[2]), -np.sin(x[2])], [np.sin(x[2]), np.cos(x[2])]]) @ [0.0, 1.0]
        force = u[0] * up + 0.5 * np.array([0.0, -9.81])
        expected = [*x[3:], *(force / 0.5), u[1] / 0.01]
        found = robot.derivative(torch.from_numpy(x), torch.from_numpy(u))
        np.testing.assert_allclose(found.numpy(), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", ["planar_quadrotor", "quadrotor"])
def test_hover_thrust_holds_a_level_robot_still(name, make_robot):
    robot = make_robot(name)
    u = torch.zeros(robot.control_dim, dtype=torch.float64)
    u[0] = -robot.mass * robot.gravity
    x = torch.zeros(robot.state_dim, dtype=torch.float64)
    torch.testing.assert_close(robot.derivative(x, u), torch.zeros_like(x), rtol=0, atol=1e-15)
    middle = 0.5 * (robot.control_lower + robot.control_upper)
    torch.testing.assert_close(middle, u)


def test_mass_and_inertia_are_options(make_robot):
    robot = make_robot("planar_quadrotor", mass=2.0, inertia=0.5, gravity=-1.0)
    found = robot.derivative(torch.zeros(6).double(), torch.tensor([4.0, 1.0]).double())
    torch.testing.assert_close(found, torch.tensor([0.0, 0.0, 0.0, 0.0, 1.0, 2.0]).double())
