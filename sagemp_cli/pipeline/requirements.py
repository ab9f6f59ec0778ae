"""What a config must satisfy before any stage starts to work: all complaints at once, before hours are spent."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sagemp_cli.config.binding import build, section_complaints
from sagemp_cli.errors import ConfigError, UsageError
from sagemp_cli.pipeline.outline import outline_complaints, source_complaints
from sagemp_cli.pipeline.problem import problem_of
from sagemp_cli.pipeline.proof import SECTION, counts_of
from sagemp_cli.pipeline.stage import all_stages
from sagemp_cli.plugins import KINDS


def require_sound_config(config: Mapping[str, Any], *, problem: bool = True) -> None:
    """Check that every section fits what it configures, that the problem is well posed and the partition is one.

    Args:
        config: resolved config.
        problem: whether to check the problem as well; a robot alone, without an experiment's sets, is none.

    Raises:
        ConfigError: one line with every complaint.
    """
    found = outline_complaints(config)
    for section in KINDS:
        found += section_complaints(config[section], section)
    found += SECTION.complaints(config)
    for stage in all_stages():
        try:
            found += stage.complaints(config)
        except ConfigError as e:  # a name that nobody knows, which is among the complaints already
            found.append(str(e))
    found += source_complaints(config)
    if problem and not any(complaint.startswith("dynamics") for complaint in found):
        found += _problem_complaints(config)
    root = next((f".{complaint}" for complaint in found if complaint.startswith("seed ")), None)
    found = [c for c in found if root is None or not c.endswith(root)]  # seeds of stages are the root's by default
    if found:
        raise ConfigError("; ".join(dict.fromkeys(found)))


def _problem_complaints(config: Mapping[str, Any]) -> list[str]:
    try:
        problem = problem_of(config)
    except UsageError as e:
        return [str(e)]
    found = []
    for check in (
        lambda: counts_of(config["proof"].get("partitions"), problem, "proof"),
        lambda: build(config["executor"], "executor"),
    ):
        try:
            check()
        except ConfigError as e:
            found.append(str(e))
    return found
