"""Experts: demonstrations by trajectory optimisation, one per start, on every sensible side of the obstacles."""

from sagemp_cli.experts.parallel import solve_problems
from sagemp_cli.experts.problems import Demonstration, Expert, PlannedDemonstration, plan_demonstrations, solve_problem
from sagemp_cli.experts.trajectory_optimization import Trajectory
from sagemp_cli.experts.transcription import Weights

__all__ = [
    "Demonstration",
    "Expert",
    "PlannedDemonstration",
    "Trajectory",
    "Weights",
    "plan_demonstrations",
    "solve_problem",
    "solve_problems",
]
