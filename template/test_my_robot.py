"""Is the robot the one that was meant? These tests need seconds; the proof is `make certificate`."""

import torch
from my_robot import MyRobot, detour

from sagemp_cli.config.composition import compose
from sagemp_cli.pipeline.problem import problem_of
from sagemp_cli.pipeline.requirements import require_sound_config

CONFIG = compose([])
PROBLEM = problem_of(CONFIG)


def test_every_option_of_the_config_is_one():
    require_sound_config(CONFIG)
    assert isinstance(PROBLEM.dynamics, MyRobot)


def test_speeds_follow_their_commands_after_the_lag():
    robot, x = PROBLEM.dynamics, torch.zeros(5, dtype=torch.float64)
    u, w = torch.tensor([1.0, 0.5], dtype=torch.float64), torch.zeros(5, dtype=torch.float64)
    for _ in range(100):
        x = robot.step(x, u, w)
    assert torch.allclose(x[3:], u, atol=1e-6)


def test_it_drives_where_it_looks():
    x = torch.tensor([0.0, 0.0, torch.pi / 2, 1.0, 0.0], dtype=torch.float64)
    rate = PROBLEM.dynamics.derivative(x, torch.tensor([1.0, 0.0], dtype=torch.float64))
    assert torch.allclose(rate[:3], torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), atol=1e-12)


def test_the_planner_of_our_own_gives_plans_that_keep_clear():
    start, count = PROBLEM.start.center.expand(20, 5), 20
    plans = detour(
        start,
        PROBLEM.scene.goal,
        PROBLEM.scene,
        count,
        torch.Generator().manual_seed(0),
        horizon=PROBLEM.horizon,
        dt=PROBLEM.dynamics.dt,
    )
    assert bool((PROBLEM.scene.signed_distance_along(plans[..., :2]) > 0).all())
