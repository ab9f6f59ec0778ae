"""Running the robot: Algorithm 3 under random and worst-case disturbances."""

from sagemp_cli.execution.disturbances import random_disturbances, worst_case_disturbances
from sagemp_cli.execution.open_loop import OpenLoop
from sagemp_cli.execution.runner import Execution, execute_queries, inside_tube
from sagemp_cli.execution.trials import DISTURBANCES, SafetyTrials, Trials, require_certified_safe, try_references

__all__ = [
    "DISTURBANCES",
    "Execution",
    "OpenLoop",
    "SafetyTrials",
    "Trials",
    "execute_queries",
    "inside_tube",
    "random_disturbances",
    "require_certified_safe",
    "try_references",
    "worst_case_disturbances",
]
