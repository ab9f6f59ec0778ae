"""Which demonstrations to make, and how one is made: every side is tried, and one of the good ones is kept."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge
from numpy.typing import NDArray

from sagemp_cli.config.ranges import Count, NonNegative, OrInfinite, Positive
from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.errors import ConfigError
from sagemp_cli.experts.homotopy import guesses
from sagemp_cli.experts.trajectory_optimization import Trajectory, optimize_trajectory, start_failure
from sagemp_cli.experts.transcription import Transcription, Weights
from sagemp_cli.scenes import Scene
from sagemp_cli.sets import Box

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PlannedDemonstration:
    """A start to demonstrate from; it depends on ``(seed, index)`` alone, not on which others were planned or solved.

    Attributes:
        index: number of the demonstration.
        seed: the run's seed.
        start: ``x_0 (n,)``.
    """

    index: int
    seed: int
    start: Array


@dataclass(frozen=True, eq=False)
class Demonstration:
    """What became of a problem.

    Attributes:
        problem: what was asked.
        trajectory: the demonstration, or None when there is none.
        failure: why there is none, or empty.
        classes_tried: combinations of sides from which an optimisation began.
        classes_found: different combinations of sides among the feasible optima.
        seconds: processor time (differs from run to run; everything else is reproducible).
    """

    problem: PlannedDemonstration
    trajectory: Trajectory | None
    failure: str
    classes_tried: int
    classes_found: int
    seconds: float


@dataclass(frozen=True, eq=False)
class Expert:
    """Everything that the demonstrations of one data set have in common.

    Attributes:
        dynamics: the robot.
        scene: workspace, obstacles and goal box.
        horizon: number of steps K.
        weights: the cost.
        margin: metres to keep from every obstacle.
        workspace_margin: metres to keep from the workspace's walls.
        temperature: how the kept class is drawn among the feasible ones: 0 keeps the cheapest; T > 0 draws class i
            with probability proportional to ``exp(-J_i / T)`` (in units of the cost); infinity draws uniformly. A
            planner that can only answer one plan per start (a neural ODE) wants 0, a generative one wants more.
        longest_detour: classes whose guess is longer than this many times the shortest one are not tried.
        optimality: scaled KKT error at which an optimisation stops.
        tolerance: the most by which a constraint may be violated.
        max_iterations: Newton steps per optimisation.
    """

    dynamics: Dynamics
    scene: Scene
    horizon: int
    weights: Weights
    margin: NonNegative
    workspace_margin: NonNegative = 0.0
    temperature: Annotated[float, Ge(0), OrInfinite()] = 0.0
    longest_detour: Annotated[float, Ge(1)] = 1.3
    optimality: Positive = 1e-4
    tolerance: Positive = 1e-6
    max_iterations: Count = 200

    def __post_init__(self) -> None:
        if not self.temperature >= 0:
            raise ConfigError(f"temperature must be zero or positive, found {self.temperature}")
        if not (self.margin >= 0 and self.workspace_margin >= 0):
            raise ConfigError(
                f"margin and workspace_margin must not be negative, found {self.margin} and {self.workspace_margin}"
            )
        if not self.longest_detour >= 1:
            raise ConfigError(f"longest_detour must be at least 1, found {self.longest_detour}")
        self.transcription(np.zeros(self.dynamics.state_dim))  # complain about weights and scene now, not per problem

    def transcription(self, start: Array) -> Transcription:
        """The optimisation problem from a start ``(n,)``."""
        return Transcription(
            self.dynamics,
            self.scene,
            start=start,
            horizon=self.horizon,
            weights=self.weights,
            margin=self.margin,
            workspace_margin=self.workspace_margin,
        )


def plan_demonstrations(starts: Box, count: int, *, seed: int) -> list[PlannedDemonstration]:
    """Problems 0..count-1 with starts drawn uniformly from a box ``(n,)``.

    Start i is the same for every count, so a data set can be enlarged by planning again with a larger one.
    """
    if count < 1:
        raise ConfigError(f"count of demonstrations must be at least 1, found {count}")
    if seed < 0:
        raise ConfigError(f"seed must not be negative, found {seed}")
    low, width = starts.lower.numpy(), starts.width.numpy()
    return [
        PlannedDemonstration(index, seed, low + width * np.random.default_rng([seed, index, 0]).random(len(low)))
        for index in range(count)
    ]


def solve_problem(problem: PlannedDemonstration, expert: Expert) -> Demonstration:
    """One demonstration, or the reason why there is none; never raises for a problem that is merely infeasible.

    Every plausible combination of sides (:func:`~sagemp_cli.experts.homotopy.guesses`) is optimised; of the
    optima that meet all constraints after the rollout, the cheapest per measured combination of sides competes, and
    ``expert.temperature`` decides.
    """
    began = time.process_time()

    def outcome(trajectory: Trajectory | None, failure: str, tried: int, found: int) -> Demonstration:
        return Demonstration(problem, trajectory, failure, tried, found, time.process_time() - began)

    transcription = expert.transcription(problem.start)
    failure = start_failure(transcription)
    if failure:
        return outcome(None, failure, 0, 0)
    place = list(expert.dynamics.position)
    paths = guesses(
        expert.scene,
        problem.start[place],
        transcription.goal_center[place],
        horizon=expert.horizon,
        margin=expert.margin,
        longest_detour=expert.longest_detour,
    )
    best: dict[tuple[int, ...], Trajectory] = {}
    failures = []
    for _, path in paths:
        trajectory = optimize_trajectory(
            transcription,
            path,
            optimality=expert.optimality,
            tolerance=expert.tolerance,
            max_iterations=expert.max_iterations,
        )
        if trajectory.failure:
            failures.append(trajectory.failure)
        elif trajectory.sides not in best or trajectory.cost < best[trajectory.sides].cost:
            best[trajectory.sides] = trajectory
    if not paths:
        return outcome(None, "no way between the obstacles: every via point beside them is blocked", 0, 0)
    if not best:
        return outcome(None, f"none of {len(paths)} classes is feasible; the shortest: {failures[0]}", len(paths), 0)
    kept = _draw(sorted(best.values(), key=lambda t: t.cost), expert.temperature, problem)
    return outcome(kept, "", len(paths), len(best))


def _draw(ascending: list[Trajectory], temperature: float, problem: PlannedDemonstration) -> Trajectory:
    if temperature == 0:
        return ascending[0]
    excess = np.array([trajectory.cost - ascending[0].cost for trajectory in ascending])
    odds = np.ones(len(excess)) if math.isinf(temperature) else np.exp(-excess / temperature)
    generator = np.random.default_rng([problem.seed, problem.index, 1])
    return ascending[int(generator.choice(len(ascending), p=odds / odds.sum()))]
