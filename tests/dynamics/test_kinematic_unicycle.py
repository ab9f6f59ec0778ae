"""The three-state unicycle against its equations, a closed form and its four-state sibling; expert and tube."""

from __future__ import annotations

import math

import numpy as np
import torch

from sagemp_cli.experts import Expert, Weights, plan_demonstrations, solve_problem
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.loop.tracker import Tracker
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.scenes import scene_from_mapping
from sagemp_cli.sets import Box


def test_the_derivative_is_that_of_the_equations(make_robot):
    x, u = torch.tensor([0.3, -0.2, 0.7], dtype=torch.float64), torch.tensor([0.5, -0.6], dtype=torch.float64)
    expected = [0.5 * math.cos(0.7), 0.5 * math.sin(0.7), -0.6]
    found = make_robot("kinematic_unicycle").derivative(x, u)
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float64), rtol=1e-15, atol=1e-15)


def test_constant_controls_walk_a_regular_polygon_of_the_right_size(make_robot):
    """Euler's step at constant speed and turn rate is a polygon; its circumradius is ``dt v / (2 sin(dt w / 2))``."""
    robot, corners = make_robot("kinematic_unicycle"), 60
    turn = 2 * math.pi / (corners * robot.dt)
    x, u = torch.zeros(3, dtype=torch.float64), torch.tensor([0.4, turn], dtype=torch.float64)
    path = [x]
    for _ in range(corners):
        path.append(robot.step(path[-1], u, torch.zeros(3, dtype=torch.float64)))
    places = torch.stack(path)[:, :2]
    torch.testing.assert_close(places[-1], places[0], rtol=0, atol=1e-12)
    radius = torch.linalg.vector_norm(places[:-1] - places[:-1].mean(0), dim=-1)
    torch.testing.assert_close(radius, torch.full_like(radius, 0.04 / (2 * math.sin(0.05 * turn))))


def test_it_moves_as_the_four_state_unicycle_does_at_the_same_speed(make_robot):
    rng = np.random.default_rng(0)
    x, v, turn = torch.from_numpy(rng.normal(size=(8, 3))), *torch.from_numpy(rng.normal(size=(2, 8, 1)))
    three = make_robot("kinematic_unicycle").derivative(x, torch.cat([v, turn], dim=-1))
    four = make_robot("unicycle").derivative(torch.cat([x, v], dim=-1), torch.cat([turn, 0 * v], dim=-1))
    torch.testing.assert_close(three, four[:, :3])


def test_the_expert_drives_it_around_a_disc(make_robot):
    scene = scene_from_mapping(
        {
            "workspace": {"lower": [-2, -2], "upper": [2, 2]},
            "obstacles": [{"kind": "ball", "center": [0, 0.05], "radius": 0.3}],
            "goal": {"lower": [1.4, -0.1, "-inf"], "upper": [1.6, 0.1, "inf"]},
        },
        state_dim=3,
        position_dim=2,
    )
    weights = Weights(effort=[1.0, 0.1], smoothness=[0.1, 0.1], goal=[100.0, 100.0, 0.0], rest=[0.4, 0.0])
    expert = Expert(make_robot("kinematic_unicycle"), scene, 80, weights, margin=0.2)
    (problem,) = plan_demonstrations(Box.around([-1.5, 0.0, 0.0], [0.05, 0.05, 0.0]), 1, seed=0)
    found = solve_problem(problem, expert).trajectory
    assert found is not None and not found.failure
    assert found.clearance >= 0.2 - 1e-6 and found.sides == (1,)


def test_a_tube_of_its_loop_holds_the_rollouts(make_robot):
    robot = make_robot("kinematic_unicycle")
    torch.manual_seed(0)
    tracker = Tracker(state_dim=3, control_dim=2, lookahead=3, hidden=[8, 8], control_offset=[0.3, 0.0])
    reference = torch.zeros(21, 3, dtype=torch.float64)
    reference[:, 0] = 0.03 * torch.arange(21)
    start = Box.around([0.0, 0.0, 0.0], [0.05, 0.05, 0.0])
    disturbance = Box.around([0.0] * 3, [0.01, 0.01, 0.05])
    loop = ClosedLoop(robot, tracker, reference)
    tube = Affine().propagate(loop, start, disturbance)
    generator = torch.Generator().manual_seed(1)
    w = disturbance.sample(500 * 20, generator).unflatten(0, (500, 20))
    states, _ = loop.rollout(start.sample(500, generator), w)
    assert bool(tube.bounded) and bool(tube.contains(states).all())
    assert float(tube.width[-1, :2].max()) < 1.0
