"""Where the references of a library start, and those of whatever is compared with one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sagemp_cli.errors import ConfigError
from sagemp_cli.sets import Box
from sagemp_cli.stages.problem import Problem


def reference_starts(config: Mapping[str, Any], problem: Problem) -> Box:
    """X_I shrunk about its centre to the share ``library.start_spread``.

    Raises:
        ConfigError: no share.
    """
    spread, center = config["library"]["start_spread"], problem.start.center
    if not isinstance(spread, int | float) or not 0 <= spread <= 1:
        raise ConfigError(f"library.start_spread must be a share of X_I in [0, 1], found {spread!r}")
    return Box(center + spread * (problem.start.lower - center), center + spread * (problem.start.upper - center))
