"""What a config must satisfy before any stage starts to work: all complaints at once, before hours are spent."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sagemp_cli.config import all_complaints
from sagemp_cli.errors import ConfigError, UsageError
from sagemp_cli.reachability.partition import parse_partitions, uncertain_dimensions
from sagemp_cli.stages.problem import problem_of


def require_sound_config(config: Mapping[str, Any]) -> None:
    """Check that every section fits its class, that the problem is well posed and that the partition is one.

    Raises:
        ConfigError: one line with every complaint.
    """
    found = all_complaints(config)
    if not any(complaint.startswith("dynamics") for complaint in found):
        try:
            problem = problem_of(config)
            _require_partition(config["verify"]["partitions"], len(uncertain_dimensions(problem.start)))
        except UsageError as e:
            found.append(str(e))
    if found:
        raise ConfigError("; ".join(found))


def _require_partition(value: Any, uncertain: int) -> None:
    try:
        parse_partitions(value, uncertain)
    except UsageError as e:
        raise ConfigError(f"verify.{e}") from None
