from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sagemp_cli.errors import ConfigError
from sagemp_cli.experts.transcription import Transcription, Weights
from sagemp_cli.scenes import Ball, Block, Scene
from sagemp_cli.sets import Box

START = np.array([0.0, 0.2, 0.1, 1.0])


def central_differences(function, z, step=1e-6):
    columns = []
    for index in np.ndindex(z.shape):
        high, low = z.copy(), z.copy()
        high[index] += step
        low[index] -= step
        columns.append((np.asarray(function(high)) - np.asarray(function(low))) / (2 * step))
    return np.stack(columns, axis=-1)


@pytest.fixture
def problem(unicycle, slalom):
    """Five steps with a disc and a block, so that both kinds of obstacle are differentiated."""
    scene = replace(slalom, obstacles=(slalom.obstacles[0], Block((3.0, 0.5), (4.0, 1.5), "block")))
    weights = Weights(effort=[1.0, 0.5], smoothness=[0.3, 0.2], goal=[1.0, 2.0, 3.0, 4.0], rest=[0.1, -0.2])
    return Transcription(unicycle, scene, start=START, horizon=5, weights=weights, margin=0.3)


@pytest.fixture
def chain():
    return np.random.default_rng(0).normal(size=(6, 6)) + np.array([2.0, 0.0, 0.0, 1.0, 0.0, 0.0])


def test_the_costs_gradient_agrees_with_finite_differences(problem, chain):
    np.testing.assert_allclose(
        problem.cost_gradient(chain).ravel(), central_differences(problem.cost, chain), atol=1e-7
    )


def test_the_costs_curvature_agrees_with_finite_differences(problem, chain):
    diagonal, coupling = problem.cost_curvature()
    hessian = central_differences(lambda z: problem.cost_gradient(z).ravel(), chain)
    rebuilt = np.diag(diagonal.ravel())
    for k in range(5):
        for i in range(2):
            a, b = 6 * k + 4 + i, 6 * (k + 1) + 4 + i
            rebuilt[a, b] = rebuilt[b, a] = coupling[k, i]
    np.testing.assert_allclose(hessian, rebuilt, atol=1e-6)


def test_the_constraints_jacobians_agree_with_finite_differences(problem, chain):
    dynamics_jacobian, jacobian = problem.jacobians(chain)
    defects = central_differences(lambda z: problem.constraints(z)[0], chain).reshape(6, 4, 6, 6)
    for k in range(5):
        np.testing.assert_allclose(dynamics_jacobian[k], defects[k + 1, :, k], atol=1e-8)
        np.testing.assert_allclose(defects[k, :, k, :4], -np.eye(4), atol=1e-8)
    active = problem.active
    numeric = central_differences(lambda z: np.where(active, problem.constraints(z)[1], 0.0), chain)
    numeric = numeric.reshape(*active.shape, 6, 6)
    for k in range(6):
        np.testing.assert_allclose(jacobian[k][active[k]], numeric[k][active[k]][:, k], atol=1e-8)


def test_a_rollout_has_no_defects(problem):
    controls = np.random.default_rng(1).uniform(-1, 1, size=(5, 2))
    states = problem.rollout(controls)
    z = np.concatenate([states, np.concatenate([controls, np.zeros((1, 2))])], axis=1)
    assert np.abs(problem.constraints(z)[0]).max() < 1e-15


def test_the_start_is_free_of_constraints_and_the_goal_binds_at_the_end_only(problem):
    assert not problem.active[0, :4].any() and not problem.active[0, 6:10].any() and not problem.active[0, 12:].any()
    assert problem.lower[-1, 0] == pytest.approx(4.8) and problem.lower[-2, 0] == -2.0
    assert np.isinf(problem.lower[-1, 4:]).all()


def test_dimensions_without_a_goal_are_not_aimed_at(point_mass, open_space):
    weights = Weights(effort=[1.0] * 3, smoothness=[0.0] * 3, goal=[1.0] * 6)
    problem = Transcription(point_mass, open_space, start=np.zeros(6), horizon=4, weights=weights, margin=0.0)
    assert np.isnan(problem.goal_center[3:]).all()
    z = np.zeros((5, 9))
    before = problem.cost(z)
    z[-1, 3:6] = 7.0
    assert problem.cost(z) == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": Weights([1.0], [0.1, 0.1], [1.0] * 4)}, "weights.effort needs 2 numbers, found 1"),
        (
            {"weights": Weights([0.0, 1.0], [0.1, 0.1], [1.0] * 4)},
            r"weights.effort must be positive, found \[0.0, 1.0\]",
        ),
        ({"weights": Weights([1.0, 1.0], [0.1, -0.1], [1.0] * 4)}, "weights.smoothness must be not negative"),
        ({"start": np.zeros(3)}, r"the start needs 4 numbers, found shape \(3,\)"),
        ({"horizon": 1}, "horizon must be at least 2 steps, found 1"),
        ({"workspace_margin": 4.0}, "no room is left inside the state limits"),
    ],
)
def test_arguments_that_do_not_fit_are_refused_by_name(unicycle, slalom, change, message):
    arguments = {
        "start": START,
        "horizon": 5,
        "weights": Weights([1.0, 1.0], [0.1, 0.1], [1.0] * 4),
        "margin": 0.3,
        **change,
    }
    with pytest.raises(ConfigError, match=message):
        Transcription(unicycle, slalom, **arguments)


def test_a_goal_without_a_place_is_refused(unicycle):
    infinite = torch.full((4,), math.inf)
    scene = Scene(Box(-torch.ones(2), torch.ones(2)), (Ball((0.5, 0.5), 0.1),), Box(-infinite, infinite))
    with pytest.raises(ConfigError, match="the goal box must bound the position"):
        Transcription(
            unicycle,
            scene,
            start=START,
            horizon=5,
            weights=Weights([1.0, 1.0], [0.1, 0.1], [1.0] * 4),
            margin=0.0,
        )
