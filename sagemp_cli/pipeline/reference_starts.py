"""Where the references of a library start, and those of whatever is compared with one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sagemp_cli.sets import Box
from sagemp_cli.verification.problem import Problem


def reference_starts(config: Mapping[str, Any], problem: Problem) -> Box:
    """X_I shrunk about its centre to the share ``library.start_spread``."""
    spread, center = config["library"]["start_spread"], problem.start.center
    return Box(center + spread * (problem.start.lower - center), center + spread * (problem.start.upper - center))


def spread_complaints(config: Mapping[str, Any]) -> list[str]:
    """What is wrong with ``library.start_spread``."""
    spread = config["library"].get("start_spread")
    good = isinstance(spread, int | float) and 0 <= spread <= 1
    return [] if good else [f"library.start_spread must be a share of X_I in [0, 1], found {spread!r}"]
