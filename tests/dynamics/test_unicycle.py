"""The unicycle against its equations and against a closed-form motion."""

from __future__ import annotations

import math

import torch


def test_the_derivative_is_that_of_the_equations(make_robot):
    x, u = [0.3, -0.2, 0.7, 1.3], [0.4, -0.6]
    found = make_robot("unicycle").derivative(torch.tensor(x).double(), torch.tensor(u).double())
    expected = [1.3 * math.cos(0.7), 1.3 * math.sin(0.7), 0.4, -0.6]
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float64), rtol=1e-6, atol=1e-7)


def test_straight_on_at_constant_acceleration_it_goes_as_far_as_euler_says(make_robot):
    robot = make_robot("unicycle")
    x = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    u, w = torch.tensor([0.0, 0.5], dtype=torch.float64), torch.zeros(4, dtype=torch.float64)
    for _ in range(10):
        x = robot.step(x, u, w)
    # v_k = 1 + 0.05 k, and px is dt times the sum of v_0..v_9.
    torch.testing.assert_close(x, torch.tensor([0.1 * (10 + 0.05 * 45), 0.0, 0.0, 1.5], dtype=torch.float64))
