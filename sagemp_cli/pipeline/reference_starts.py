"""Where the references of a library start, and those of whatever is compared with one."""

from __future__ import annotations

from typing import Annotated

from annotated_types import Interval, doc

from sagemp_cli.problem import Problem
from sagemp_cli.sets import Box

XIShare = Annotated[float, Interval(ge=0, le=1), doc("a share of X_I in [0, 1]")]


def reference_starts(problem: Problem, spread: float) -> Box:
    """X_I shrunk about its centre to a share of its size, ``library.start_spread``."""
    center = problem.start.center
    return Box(center + spread * (problem.start.lower - center), center + spread * (problem.start.upper - center))
