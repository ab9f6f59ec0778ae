"""One expert trajectory: optimised near a guess, rolled out, and measured as it will be stored.

The optimiser stops when defects are below its tolerance; the trajectory that is returned is the *rollout* of its
controls under the float64 dynamics, so states and controls belong together exactly, and every figure (limits,
clearance, goal, cost, optimality) is measured on that rollout.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from sagemp_cli.experts.initial_guess import fill_path
from sagemp_cli.experts.interior_point import optimality_error, solve_chain
from sagemp_cli.experts.transcription import Transcription
from sagemp_cli.scenes.sides import sides_of

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Trajectory:
    """A rollout with its figures.

    Attributes:
        states: ``(K+1, n)``, the rollout of ``controls`` from the start without disturbance.
        controls: ``(K, m)``.
        sides: side per obstacle, as measured on the rollout; indices into ``scenes.sides.SIDE_NAMES``.
        cost: J (see :class:`~sagemp_cli.experts.transcription.Weights`).
        control_violation: most by which a control exceeds its limits (0 inside).
        state_violation: most by which a state of steps 1..K exceeds limits or the shrunken workspace.
        clearance: smallest distance to an obstacle over all steps, metres (infinite without obstacles).
        goal_violation: most by which ``x_K`` exceeds the goal box.
        goal_error: distance of ``x_K`` to the goal box's centre over its bounded dimensions (mixed units).
        optimality: scaled KKT error (:func:`~sagemp_cli.experts.interior_point.optimality_error`).
        iterations: Newton steps taken.
        failure: why this is no demonstration, naming constraint and step; empty when all constraints hold.
    """

    states: Array
    controls: Array
    sides: tuple[int, ...]
    cost: float
    control_violation: float
    state_violation: float
    clearance: float
    goal_violation: float
    goal_error: float
    optimality: float
    iterations: int
    failure: str


def start_failure(problem: Transcription) -> str:
    """Why no trajectory can begin at the problem's start, or an empty string."""
    start, dynamics = problem.start, problem.dynamics
    if not np.isfinite(start).all():
        return f"the start is not finite: {start.tolist()}"
    for i, name in enumerate(dynamics.state_names):
        low, high = problem.lower[1, i], problem.upper[1, i]
        if not low <= start[i] <= high:
            return f"the start's {name} is {start[i]:.4g}, allowed is {low:.4g} to {high:.4g}"
    place = torch.from_numpy(start[list(dynamics.position)])
    for obstacle in problem.scene.obstacles:
        distance = float(obstacle.signed_distance(place))
        if distance < 0:
            return f"the start lies inside obstacle '{obstacle.name}' ({-distance:.4g} m deep)"
        if distance < problem.margin:
            return (
                f"the start is {distance:.4g} m from obstacle '{obstacle.name}', "
                f"closer than the margin of {problem.margin:.4g} m"
            )
    return ""


def optimize_trajectory(
    problem: Transcription,
    path: Array,
    *,
    optimality: float = 1e-4,
    tolerance: float = 1e-6,
    max_iterations: int = 200,
) -> Trajectory:
    """The locally optimal trajectory near a path of positions ``(K+1, d)``, with its figures.

    Args:
        problem: robot, scene, start, cost and margins.
        path: first guess of the positions.
        optimality: scaled KKT error at which the optimiser stops.
        tolerance: the most by which a constraint may be violated after the rollout.
        max_iterations: Newton steps after which to give up.
    """
    n = problem.state_dim
    guess = fill_path(problem.dynamics, path, start=problem.start, goal=problem.goal_center)
    solution = solve_chain(
        problem, guess, optimality=optimality, feasibility=0.01 * tolerance, max_iterations=max_iterations
    )
    controls = solution.z[:-1, n:].copy()
    # Slacks keep controls inside their limits up to the tolerance; clipping makes it exact, before the rollout.
    controls = np.clip(controls, problem.lower[:-1, n:], problem.upper[:-1, n:])
    states = problem.rollout(controls)
    z = np.concatenate([states, np.concatenate([controls, solution.z[-1:, n:]])], axis=1)

    excess = np.maximum(np.maximum(problem.lower - z, z - problem.upper), 0.0)
    goal = problem.scene.goal
    beyond_goal = np.maximum(np.maximum(goal.lower.numpy() - states[-1], states[-1] - goal.upper.numpy()), 0.0)
    bounded = ~np.isnan(problem.goal_center)
    places = states[:, list(problem.dynamics.position)]
    distances = np.stack(
        [o.signed_distance(torch.from_numpy(places)).numpy() for o in problem.scene.obstacles]
        or [np.full(len(places), np.inf)]
    )
    return Trajectory(
        states=states,
        controls=controls,
        sides=sides_of(places, problem.scene.obstacles),
        cost=problem.cost(z),
        control_violation=float(excess[:, n:].max()),
        state_violation=float(excess[:-1, :n].max()),
        clearance=float(distances.min()),
        goal_violation=float(beyond_goal.max()),
        goal_error=float(np.linalg.norm((states[-1] - problem.goal_center)[bounded])),
        optimality=optimality_error(problem, z, solution.multipliers, solution.duals),
        iterations=solution.iterations,
        failure=_failure(problem, excess, distances, beyond_goal, tolerance) or solution.reason,
    )


def _failure(problem: Transcription, excess: Array, distances: Array, beyond_goal: Array, tolerance: float) -> str:
    """The first of the constraints that the rollout does not meet within the tolerance, in words."""
    dynamics, n = problem.dynamics, problem.state_dim
    names = (*dynamics.state_names, *dynamics.control_names)
    if not np.isfinite(excess).all():
        return "the rollout overflows"
    worst, step = np.unravel_index(distances.argmin(), distances.shape)
    if distances[worst, step] < problem.margin - tolerance:
        name = problem.scene.obstacles[worst].name
        return (
            f"{distances[worst, step]:.4g} m from obstacle '{name}' at step {step}, "
            f"closer than the margin of {problem.margin:.4g} m"
        )
    if beyond_goal.max() > tolerance:
        i = int(beyond_goal.argmax())
        return f"{names[i]} misses the goal box by {beyond_goal[i]:.4g}"
    step, i = np.unravel_index(excess.argmax(), excess.shape)
    if excess[step, i] > tolerance:
        kind = "state" if i < n else "control"
        return f"{names[i]} exceeds its {kind} limits by {excess[step, i]:.4g} at step {step}"
    return ""
