from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from sagemp_cli.experts.homotopy import guesses
from sagemp_cli.experts.initial_guess import fill_path
from sagemp_cli.experts.interior_point import optimality_error, solve_chain
from sagemp_cli.experts.transcription import Transcription, Weights


def test_a_linear_quadratic_problem_has_the_optimum_of_its_normal_equations(point_mass, open_space):
    horizon, start = 12, np.array([2.0, 0.5, 1.5, 0.3, 0.0, -0.2])
    weights = Weights(effort=[1.0, 2.0, 3.0], smoothness=[0.05, 0.0, 0.1], goal=[40.0] * 6)
    problem = Transcription(point_mass, open_space, start=start, horizon=horizon, weights=weights, margin=0.0)
    path = np.linspace(start[:3], problem.goal_center[:3], horizon + 1)
    guess = fill_path(point_mass, path, start=start, goal=problem.goal_center)
    solution = solve_chain(problem, guess, optimality=1e-8)
    assert solution.converged, solution.reason

    # x_K is affine in the controls, so the optimum solves one linear system (no constraint is active here).
    def end(controls):
        return problem.rollout(controls.reshape(horizon, 3))[-1, :3]

    base = end(np.zeros(horizon * 3))
    effect = np.stack([end(unit) - base for unit in np.eye(horizon * 3)], axis=1)
    effort = 0.1 * np.tile([1.0, 2.0, 3.0], horizon)
    change = np.kron(np.diff(np.eye(horizon), axis=0), np.eye(3))
    rate = np.tile(np.array([0.05, 0.0, 0.1]) / 0.1, horizon - 1)
    matrix = np.diag(effort) + change.T @ (rate[:, None] * change) + 40.0 * effect.T @ effect
    controls = np.linalg.solve(matrix, 40.0 * effect.T @ (problem.goal_center[:3] - base))
    np.testing.assert_allclose(solution.z[:-1, 6:], controls.reshape(horizon, 3), atol=1e-5)


def test_the_optimum_beside_an_obstacle_is_the_one_that_slsqp_finds(unicycle, slalom):
    unicycle.dt = 0.5  # ten steps: small enough for a dense solver
    horizon, start = 10, np.array([0.0, 0.2, 0.0, 1.0])
    weights = Weights(effort=[1.0, 1.0], smoothness=[0.1, 0.1], goal=[10.0] * 4)
    problem = Transcription(unicycle, slalom, start=start, horizon=horizon, weights=weights, margin=0.1)
    _, path = guesses(slalom, start[:2], problem.goal_center[:2], horizon=horizon, margin=0.1)[0]
    guess = fill_path(unicycle, path, start=start, goal=problem.goal_center)
    ours = solve_chain(problem, guess, optimality=1e-7)
    assert ours.converged, ours.reason

    shape = guess.shape
    theirs = minimize(
        lambda v: problem.cost(v.reshape(shape)),
        guess.ravel(),
        jac=lambda v: problem.cost_gradient(v.reshape(shape)).ravel(),
        method="SLSQP",
        constraints=[
            {"type": "eq", "fun": lambda v: problem.constraints(v.reshape(shape))[0].ravel()},
            {"type": "ineq", "fun": lambda v: problem.constraints(v.reshape(shape))[1][problem.active]},
        ],
        options={"maxiter": 300, "ftol": 1e-12},
    )
    assert theirs.success, theirs.message
    assert problem.constraints(ours.z)[1][:, 2 * shape[1] :].min() < 1e-4, "an obstacle must be active in this test"
    assert problem.cost(ours.z) == pytest.approx(theirs.fun, rel=1e-5)
    np.testing.assert_allclose(ours.z[:-1], theirs.x.reshape(shape)[:-1], atol=2e-3)


def test_the_optimality_error_is_small_at_the_optimum_only(expert):
    problem = expert.transcription(np.array([0.0, 0.2, 0.0, 1.0]))
    _, path = guesses(expert.scene, problem.start[:2], problem.goal_center[:2], horizon=25, margin=0.3)[0]
    guess = fill_path(expert.dynamics, path, start=problem.start, goal=problem.goal_center)
    solution = solve_chain(problem, guess, optimality=1e-5)
    assert optimality_error(problem, solution.z, solution.multipliers, solution.duals) <= 1e-5
    nudged = solution.z.copy()
    nudged[10, 4] += 0.01
    assert optimality_error(problem, nudged, solution.multipliers, solution.duals) > 1e-4


def test_too_few_iterations_are_a_reason_and_not_a_result(expert):
    problem = expert.transcription(np.array([0.0, 0.2, 0.0, 1.0]))
    _, path = guesses(expert.scene, problem.start[:2], problem.goal_center[:2], horizon=25, margin=0.3)[0]
    guess = fill_path(expert.dynamics, path, start=problem.start, goal=problem.goal_center)
    solution = solve_chain(problem, guess, max_iterations=3)
    assert not solution.converged
    assert solution.reason == "no convergence in 3 iterations"
