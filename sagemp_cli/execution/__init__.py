"""Running the robot: Algorithm 3 under random and worst-case disturbances."""

from sagemp_cli.execution.disturbances import random_disturbances, worst_case_disturbances
from sagemp_cli.execution.runner import Execution, execute_queries, inside_tube

__all__ = ["Execution", "execute_queries", "inside_tube", "random_disturbances", "worst_case_disturbances"]
