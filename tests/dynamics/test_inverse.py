"""Controls recovered from plans: exact on rollouts, least squares and within the limits elsewhere."""

from __future__ import annotations

import pytest
import torch

from sagemp_cli.dynamics import Dynamics
from sagemp_cli.dynamics.inverse import invert
from sagemp_cli.errors import NonFiniteError, UsageError
from sagemp_cli.sets import Box


def rolled(robot: Dynamics, *, count: int = 3, steps: int = 12) -> tuple[torch.Tensor, torch.Tensor]:
    """Undisturbed rollouts under random controls within the limits, from random states near the origin."""
    generator = torch.Generator().manual_seed(1)
    u = Box(robot.control_lower, robot.control_upper).sample(count * steps, generator).unflatten(0, (count, steps))
    states = [0.2 * torch.randn(count, robot.state_dim, dtype=torch.float64, generator=generator)]
    for k in range(steps):
        states.append(robot.step(states[-1], u[:, k], torch.zeros_like(states[-1])))
    return torch.stack(states, 1), u


@pytest.mark.parametrize("name", ["unicycle", "kinematic_unicycle", "planar_quadrotor", "quadrotor"])
def test_the_controls_of_a_rollout_come_back_and_nothing_is_left(make_robot, name):
    robot = make_robot(name)
    states, controls = rolled(robot)
    found = invert(robot, states)
    torch.testing.assert_close(found.controls, controls, rtol=1e-9, atol=1e-9)
    assert found.residual.shape == (3, 12, robot.state_dim)
    assert found.residual.abs().max() < 1e-9


def test_a_single_plan_needs_no_batch(make_robot):
    robot = make_robot("unicycle")
    states, controls = rolled(robot, count=1)
    torch.testing.assert_close(invert(robot, states[0]).controls, controls[0])


def test_what_a_unicycle_cannot_do_is_left_in_the_residual(make_robot):
    """Driving straight ahead at 0.5 m/s while the plan slides sideways at 0.3 m/s and turns at 0.4 rad/s."""
    robot = make_robot("kinematic_unicycle")
    plan = torch.zeros(2, 3, dtype=torch.float64)
    plan[1] = robot.dt * torch.tensor([0.5, 0.3, 0.4], dtype=torch.float64)
    found = invert(robot, plan)
    expected = {"controls": [[0.5, 0.4]], "residual": [[0.0, 0.3, 0.0]]}
    for name, values in expected.items():
        torch.testing.assert_close(getattr(found, name), torch.tensor(values, dtype=torch.float64))


def test_thrust_is_the_projection_of_what_the_plan_asks_on_the_robots_axis(make_robot):
    """A tilted quadrotor whose plan stands still: the thrust that comes nearest is hover thrust times cos(phi)."""
    robot = make_robot("planar_quadrotor")
    phi = torch.tensor(0.3, dtype=torch.float64)
    plan = torch.zeros(2, 6, dtype=torch.float64)
    plan[:, 2] = phi
    found = invert(robot, plan)
    hover = -robot.mass * robot.gravity
    torch.testing.assert_close(found.controls[0], torch.stack([hover * torch.cos(phi), torch.zeros_like(phi)]))
    # Gravity's part across the axis is left, g sin(phi).
    assert found.residual[0, 3:5].norm().item() == pytest.approx(-robot.gravity * float(torch.sin(phi)))


def test_controls_are_clamped_into_the_limits_unless_told_otherwise(make_robot):
    robot = make_robot("unicycle", control_lower=[-1.0, -1.0], control_upper=[1.0, 1.0])
    plan = torch.zeros(2, 4, dtype=torch.float64)
    plan[1, 2:] = robot.dt * torch.tensor([3.0, -2.0], dtype=torch.float64)
    assert invert(robot, plan).controls.tolist() == [[1.0, -1.0]]
    torch.testing.assert_close(invert(robot, plan).residual[0, 2:], torch.tensor([2.0, -1.0], dtype=torch.float64))
    free = invert(robot, plan, within_limits=False)
    torch.testing.assert_close(free.controls, torch.tensor([[3.0, -2.0]], dtype=torch.float64))
    assert free.residual.abs().max() < 1e-12


class Drag(Dynamics):
    """A cart whose propeller pushes with the square of its speed."""

    state_names, state_units = ("px",), ("m",)
    control_names, control_units = ("spin",), ("1/s",)
    position = (0,)

    def derivative(self, x, u):
        return u * u


@pytest.mark.parametrize("limits", [(-1.0, 1.0), (0.0, 2.0), (-2.0, 0.0)])
def test_a_robot_that_is_not_affine_in_its_controls_is_refused_by_name(limits):
    low, high = limits
    robot = Drag(dt=0.1, control_lower=[low], control_upper=[high], state_lower=[-1.0], state_upper=[1.0])
    message = "Drag has no inverse: its derivative is not affine in the control, so a plan's controls cannot be"
    with pytest.raises(UsageError, match=message):
        invert(robot, torch.zeros(4, 1, dtype=torch.float64))


@pytest.mark.parametrize("shape", [(4,), (1, 4), (5, 3)])
def test_a_plan_of_another_shape_is_refused(make_robot, shape):
    with pytest.raises(UsageError, match=r"plans to invert must have shape \(\.\.\., K\+1, 4\), found"):
        invert(make_robot("unicycle"), torch.zeros(shape, dtype=torch.float64))


def test_a_plan_with_a_nan_is_refused(make_robot):
    with pytest.raises(NonFiniteError, match="a plan to invert contains NaN or infinity"):
        invert(make_robot("unicycle"), torch.full((5, 4), torch.nan, dtype=torch.float64))
