from __future__ import annotations

import re

import numpy as np
import pytest
import torch

from sagemp_cli.experts.homotopy import guesses
from sagemp_cli.experts.trajectory_optimization import optimize_trajectory, start_failure
from sagemp_cli.experts.transcription import Transcription, Weights
from sagemp_cli.scenes import Ball, Scene
from sagemp_cli.sets import Box

START = np.array([0.0, 0.1, 0.0, 1.0])


def paths(problem, margin):
    place = list(problem.dynamics.position)
    ends = problem.start[place], problem.goal_center[place]
    return guesses(problem.scene, *ends, horizon=problem.horizon, margin=margin)


@pytest.fixture
def trajectory(expert):
    problem = expert.transcription(START)
    return optimize_trajectory(problem, paths(problem, 0.3)[0][1])


def test_a_rollout_of_the_stored_controls_reproduces_the_stored_states(expert, trajectory):
    x, w = torch.from_numpy(START), torch.zeros(4, dtype=torch.float64)
    for k, u in enumerate(torch.from_numpy(trajectory.controls)):
        assert np.abs(trajectory.states[k] - x.numpy()).max() <= 1e-9
        x = expert.dynamics.step(x, u, w)
    assert np.abs(trajectory.states[-1] - x.numpy()).max() <= 1e-9


def test_all_constraints_hold_when_measured_independently(expert, trajectory):
    assert trajectory.failure == ""
    states, controls, scene = trajectory.states, trajectory.controls, expert.scene
    np.testing.assert_array_equal(states[0], START)
    assert (controls >= [-1.5, -2.0]).all() and (controls <= [1.5, 2.0]).all()
    assert (states[:, 2:] >= np.array([-1.5, 0.0]) - 1e-6).all() and (
        states[:, 2:] <= np.array([1.5, 3.0]) + 1e-6
    ).all()
    clearance = min(np.linalg.norm(states[:, :2] - ball.center, axis=1).min() - ball.radius for ball in scene.obstacles)
    assert clearance >= 0.3 - 1e-6
    assert clearance == pytest.approx(trajectory.clearance)
    assert bool(scene.goal.contains(torch.from_numpy(states[-1])))
    assert trajectory.control_violation == trajectory.state_violation == trajectory.goal_violation == 0.0
    assert trajectory.optimality <= 1e-3
    assert trajectory.goal_error < 0.05


def test_each_guess_ends_on_the_side_that_it_asks_for(expert):
    problem = expert.transcription(START)
    for sides, path in paths(problem, 0.3):
        found = optimize_trajectory(problem, path)
        assert (found.failure, found.sides) == ("", sides)


def test_a_goal_out_of_reach_fails_with_the_constraint_that_is_not_met(unicycle, slalom):
    weights = Weights([1.0, 1.0], [0.1, 0.1], [1.0] * 4)
    problem = Transcription(unicycle, slalom, start=START, horizon=10, weights=weights, margin=0.3)  # 5 m in 1 s
    found = optimize_trajectory(problem, np.linspace(START[:2], [5.0, 0.0], 11), max_iterations=40)
    assert "closer than the margin" in found.failure or "misses the goal box" in found.failure


def test_an_optimisation_cut_short_is_a_failure(expert):
    problem = expert.transcription(START)
    found = optimize_trajectory(problem, paths(problem, 0.3)[0][1], max_iterations=2)
    assert found.failure


@pytest.mark.parametrize(
    ("start", "reason"),
    [
        ([2.0, -0.2, 0.0, 1.0], r"the start lies inside obstacle 'first disc' \(0.4 m deep\)"),
        ([1.3, -0.3, 0.0, 1.0], "the start is 0.2 m from obstacle 'first disc', closer than the margin of 0.3 m"),
        ([0.0, 2.95, 0.0, 1.0], "the start's py is 2.95, allowed is -2.9 to 2.9"),
        ([0.0, 0.0, 0.0, 3.5], "the start's v is 3.5, allowed is 0 to 3"),
        ([0.0, float("nan"), 0.0, 1.0], "the start is not finite"),
    ],
)
def test_a_start_from_which_nothing_can_begin_is_named(expert, start, reason):
    assert re.match(reason, start_failure(expert.transcription(np.array(start))))


def test_a_good_start_has_no_failure(expert):
    assert start_failure(expert.transcription(START)) == ""


def test_a_flying_point_mass_passes_a_sphere_in_space(point_mass):
    far, goal = torch.full((3,), 6.0), torch.tensor([4.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    scene = Scene(Box(-far, far), (Ball((2.0, 0.0, 0.0), 0.5, "sphere"),), Box(goal - 0.2, goal + 0.2))
    weights = Weights(effort=[1.0] * 3, smoothness=[0.01] * 3, goal=[100.0] * 6)
    problem = Transcription(point_mass, scene, start=np.zeros(6), horizon=40, weights=weights, margin=0.2)
    reached = set()
    for _, path in paths(problem, 0.2):
        found = optimize_trajectory(problem, path)
        assert found.failure == "" and found.clearance >= 0.2 - 1e-6
        reached.add(found.sides)
    assert reached == {(0,), (1,), (2,), (3,)}
