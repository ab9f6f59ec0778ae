"""What can be said of a config without the robot, planner and tracker that it picks: its keys, sections and sources.

Nothing heavy is imported: this is what ``status`` checks.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any

from sagemp_cli.config.binding import option_complaints
from sagemp_cli.config.composition import options_of
from sagemp_cli.config.ranges import Count, Whole
from sagemp_cli.errors import ConfigError, did_you_mean
from sagemp_cli.pipeline.context import named_run_file
from sagemp_cli.pipeline.stage import all_stages
from sagemp_cli.plugins.stages import own_stages

Section = Mapping[str, Any]


@dataclass(frozen=True)
class EffortOptions:
    """The section ``effort``: a word, and what it adds to the names of folders."""

    name: str
    suffix: str


@dataclass(frozen=True)
class StartOptions:
    """The section ``start``; the problem checks the numbers, which belong to the robot's states."""

    center: Any
    radius: Any


@dataclass(frozen=True)
class DisturbanceOptions:
    """The section ``disturbance``."""

    radius: Any


@dataclass(frozen=True)
class ConfigOptions:
    """The keys at the top, and which of them are sections; what is in these is said where it is read."""

    name: str
    artifacts: str
    sources: Section
    seed: Whole
    horizon: Count
    scene: Section
    start: StartOptions
    disturbance: DisturbanceOptions
    effort: EffortOptions
    dynamics: Section
    expert: Section
    planner: Section
    tracker: Section
    tracker_training: Section
    propagator: Section
    executor: Section
    proof: Section
    verify: Section
    library: Section
    execute: Section
    safety: Section
    dynamics_training: Section | None = None
    planner_training: Section | None = None


_SECTIONS = tuple(
    f.name for f in fields(ConfigOptions) if f.type not in ("str", "Whole", "Count") and "None" not in str(f.type)
)


def require_sound_outline(config: Mapping[str, Any]) -> None:
    """Check the keys at the top and the sources.

    Raises:
        ConfigError: one line with every complaint.
    """
    found = [*outline_complaints(config), *source_complaints(config)]
    if found:
        raise ConfigError("; ".join(dict.fromkeys(found)))


def outline_complaints(config: Mapping[str, Any]) -> list[str]:
    """What is wrong with the keys at the top; what is in a section of a stage from outside is that stage's affair.

    Raises:
        ConfigError: a section is none, so that no more can be said; one line with every complaint.
    """
    own = {stage.section for stage in own_stages()}
    found = option_complaints(ConfigOptions, {key: config[key] for key in config if key not in own}, "")
    if not all(isinstance(config.get(name), Mapping) for name in _SECTIONS):
        raise ConfigError("; ".join(found))
    return found


def source_complaints(config: Mapping[str, Any]) -> Iterator[str]:
    """What is wrong with the section ``sources``."""
    sources, own = config["sources"], str(config["name"])
    every = all_stages()
    shared = [stage.name for stage in every if any(stage.name in other.inputs for other in every)]
    experiments = options_of("experiment")
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
