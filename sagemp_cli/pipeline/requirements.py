"""What a config must satisfy before any stage starts to work: all complaints at once, before hours are spent."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from sagemp_cli.config.binding import all_complaints, build
from sagemp_cli.config.composition import options_of
from sagemp_cli.errors import ConfigError, UsageError, did_you_mean
from sagemp_cli.pipeline.context import named_run_file
from sagemp_cli.pipeline.options import key_complaints
from sagemp_cli.pipeline.problem import problem_of
from sagemp_cli.pipeline.proof import partition_complaints
from sagemp_cli.pipeline.stage import STAGES
from sagemp_cli.sets.partition import uncertain_dimensions


def require_sound_config(config: Mapping[str, Any], *, problem: bool = True) -> None:
    """Check that every section fits what it configures, that the problem is well posed and the partition is one.

    Args:
        config: resolved config.
        problem: whether to check the problem as well; a robot alone, without an experiment's sets, is none.

    Raises:
        ConfigError: one line with every complaint.
    """
    found = all_complaints(config) + [complaint for stage in STAGES for complaint in stage.complaints(config)]
    found += _source_complaints(config)
    found += key_complaints(config["start"], "start", ("center", "radius"))
    found += key_complaints(config["disturbance"], "disturbance", ("radius",))
    if problem and not any(complaint.startswith("dynamics") for complaint in found):
        found += _problem_complaints(config)
    if found:
        raise ConfigError("; ".join(dict.fromkeys(found)))


def _source_complaints(config: Mapping[str, Any]) -> Iterator[str]:
    sources, own = config["sources"], str(config["name"])
    shared = [stage.name for stage in STAGES if any(stage.name in other.inputs for other in STAGES)]
    experiments = options_of("experiment")
    if not isinstance(sources, Mapping):
        yield f"sources must be a mapping of stages to experiments, found {sources!r}"
        return
    for stage, experiment in sources.items():
        if stage not in shared:
            near = did_you_mean(str(stage), shared) or f"; allowed: {', '.join(shared)}"
            yield f"sources.{stage}: no stage whose file another one could use{near}"
        if experiment is None:
            continue
        if experiment == own:
            yield f"sources.{stage}: {own} is this experiment itself"
        elif experiment not in experiments and (
            stage not in shared or named_run_file(config, str(experiment), stage) is None
        ):
            near = did_you_mean(str(experiment), experiments) or f"; known: {', '.join(experiments)}"
            yield f"sources.{stage}: no experiment '{experiment}'{near}, and no file of a run of that name"


def _problem_complaints(config: Mapping[str, Any]) -> list[str]:
    try:
        problem = problem_of(config)
    except UsageError as e:
        return [str(e)]
    found = partition_complaints(config["verify"], len(uncertain_dimensions(problem.start)))
    try:
        build(config["executor"], "executor")
    except ConfigError as e:
        found.append(str(e))
    return found
