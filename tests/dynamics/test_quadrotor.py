"""The 3-D quadrotor against rotation matrices that are built here, independently of the model's formulas."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch

from sagemp_cli.errors import ConfigError

INERTIA = np.array([0.5, 0.1, 0.3])


def rotation(psi: float, theta: float, phi: float) -> np.ndarray:
    """``R_z(psi) R_y(theta) R_x(phi)``."""
    (cz, sz), (cy, sy), (cx, sx) = ((np.cos(a), np.sin(a)) for a in (psi, theta, phi))
    about_z = np.array([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
    about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    return about_z @ about_y @ about_x


@pytest.fixture
def drawn(make_robot):
    """Twenty states (angles up to 1 rad), controls, and what the model makes of them."""
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(20, 12)), rng.normal(size=(20, 4))
    x[:, 3:6] = rng.uniform(-1.0, 1.0, size=(20, 3))
    return x, u, make_robot("quadrotor").derivative(torch.from_numpy(x), torch.from_numpy(u)).numpy()


def test_positions_move_with_their_own_velocities(drawn):
    x, _, derivative = drawn
    np.testing.assert_array_equal(derivative[:, :3], x[:, 6:9])


def test_accelerations_are_thrust_along_the_rotated_body_axis_plus_gravity(drawn):
    x, u, derivative = drawn
    for state, control, found in zip(x, u, derivative, strict=True):
        expected = rotation(*state[3:6]) @ [0.0, 0.0, control[0] / 1.0] + [0.0, 0.0, -9.81]
        np.testing.assert_allclose(found[6:9], expected, rtol=1e-12, atol=1e-12)


def test_angle_rates_turn_the_rotation_matrix_as_the_body_rates_do(drawn):
    x, _, derivative = drawn
    h = 1e-6
    for state, found in zip(x, derivative, strict=True):
        p, q, r = state[9:12]
        body = np.array([[0.0, -r, q], [r, 0.0, -p], [-q, p, 0.0]])
        after, before = (rotation(*(state[3:6] + sign * h * found[3:6])) for sign in (1, -1))
        np.testing.assert_allclose((after - before) / (2 * h), rotation(*state[3:6]) @ body, atol=1e-8)


def test_body_rates_obey_eulers_equation(drawn):
    x, u, derivative = drawn
    for state, control, found in zip(x, u, derivative, strict=True):
        omega = state[9:12]
        expected = (control[1:] - np.cross(omega, INERTIA * omega)) / INERTIA
        np.testing.assert_allclose(found[9:], expected, rtol=1e-12, atol=1e-12)


def test_inertia_needs_three_numbers(make_robot):
    with pytest.raises(ConfigError, match=re.escape("Quadrotor: inertia needs 3 numbers, found 2")):
        make_robot("quadrotor", inertia=[0.5, 0.1])
