"""What every robot model keeps to: shapes, the Euler step under both readings of the disturbance, gradients, errors."""

from __future__ import annotations

import re

import pytest
import torch

from sagemp_cli.errors import ConfigError


def points(robot, *batch, seed=0):
    """States inside the limits, controls inside theirs, small disturbances."""
    generator = torch.Generator().manual_seed(seed)

    def inside(lower, upper):
        unit = torch.rand(*batch, len(lower), dtype=torch.float64, generator=generator)
        return lower + unit * (upper - lower)

    x = inside(robot.state_lower, robot.state_upper)
    u = inside(robot.control_lower, robot.control_upper)
    w = 0.1 * torch.randn(*batch, robot.state_dim, dtype=torch.float64, generator=generator)
    return x, u, w


def test_names_units_and_limits_have_one_entry_per_state_and_control(any_robot):
    assert len(any_robot.state_units) == any_robot.state_dim == len(any_robot.state_lower) == len(any_robot.state_upper)
    assert len(any_robot.control_units) == any_robot.control_dim == len(any_robot.control_lower)
    assert len(set(any_robot.state_names)) == any_robot.state_dim
    assert all(0 <= i < any_robot.state_dim for i in any_robot.position)


def test_leading_dimensions_are_batch(any_robot):
    x, u, w = points(any_robot, 3, 2)
    together = any_robot.step(x, u, w)
    assert together.shape == x.shape and together.dtype == torch.float64
    for i in range(3):
        for j in range(2):
            torch.testing.assert_close(
                together[i, j], any_robot.step(x[i, j], u[i, j], w[i, j]), rtol=1e-15, atol=1e-15
            )


def test_the_step_is_forward_euler_with_the_disturbance_in_the_derivative(any_robot):
    x, u, w = points(any_robot, 5)
    expected = x + any_robot.dt * (any_robot.derivative(x, u) + w)
    assert any_robot.disturbance == "derivative"
    torch.testing.assert_close(any_robot.step(x, u, w), expected, rtol=1e-15, atol=1e-15)


@pytest.mark.parametrize("name", ["unicycle", "planar_quadrotor", "quadrotor"])
def test_the_other_reading_adds_the_disturbance_to_the_state(name, make_robot):
    robot = make_robot(name, disturbance="state")
    x, u, w = points(robot, 5)
    undisturbed = robot.step(x, u, torch.zeros_like(w))
    torch.testing.assert_close(robot.step(x, u, w), undisturbed + w, rtol=1e-14, atol=1e-14)
    torch.testing.assert_close(undisturbed, make_robot(name).step(x, u, torch.zeros_like(w)))


def test_a_position_moves_with_its_velocity_only(any_robot):
    x, u, _ = points(any_robot, 4)
    moved = x.clone()
    moved[..., list(any_robot.position)] += 1.7
    torch.testing.assert_close(any_robot.derivative(moved, u), any_robot.derivative(x, u))


def test_gradients_agree_with_finite_differences(any_robot):
    x, u, w = (v.requires_grad_() for v in points(any_robot, 2))
    assert torch.autograd.gradcheck(any_robot.step, (x, u, w))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dt": 0.0}, "dt must be a positive number of seconds, found 0.0"),
        ({"dt": float("inf")}, "dt must be a positive number of seconds, found inf"),
        ({"disturbance": "both"}, "disturbance must be one of derivative, state, found 'both'"),
        ({"control_lower": [0.0]}, "control_lower needs {controls} numbers, found 1"),
        ({"state_upper": [1.0, 2.0, 3.0]}, "state_upper needs {states} numbers, found 3"),
    ],
)
@pytest.mark.parametrize("name", ["unicycle", "planar_quadrotor", "quadrotor"])
def test_a_wrong_option_is_named(name, change, message, make_robot):
    robot = make_robot(name)
    expected = message.format(controls=robot.control_dim, states=robot.state_dim)
    with pytest.raises(ConfigError, match=re.escape(expected)):
        make_robot(name, **change)


def test_crossed_limits_are_refused(make_robot):
    with pytest.raises(ConfigError, match="Unicycle: every lower limit must lie below its upper limit"):
        make_robot("unicycle", control_lower=[1.5, -2.0])


def test_an_unknown_option_is_refused_with_the_nearest_known_one(make_robot):
    with pytest.raises(
        ConfigError, match=re.escape("dynamics.mas: Quadrotor has no such option (did you mean 'mass'?)")
    ):
        make_robot("quadrotor", mas=2.0)
