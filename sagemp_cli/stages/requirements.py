"""What a config must satisfy before any stage starts to work: all complaints at once, before hours are spent."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from sagemp_cli.binding import all_complaints, build, option_complaints, target_class
from sagemp_cli.config import options_of
from sagemp_cli.errors import ConfigError, UsageError, did_you_mean
from sagemp_cli.experts import Expert, Weights
from sagemp_cli.planners import train_planner
from sagemp_cli.reachability.partition import uncertain_dimensions
from sagemp_cli.reachability.refutation import attack
from sagemp_cli.stages.problem import problem_of
from sagemp_cli.stages.proof import partition_complaints
from sagemp_cli.stages.stage import STAGES, stage_named
from sagemp_cli.stages.train_dynamics import training_complaints
from sagemp_cli.trackers.losses import LossWeights
from sagemp_cli.trackers.training import train_tracker
from sagemp_cli.trackers.tube_loss import TubeLoss

_RUN = ("generator", "checkpoint", "identity", "progress")
"""Arguments of everything that trains or searches, which the stages give."""

_KEYS = {
    "verify": ("partitions", "budget", "memory", "references", "file", "falsifier", "true_model"),
    "library": ("size", "budget", "start_spread"),
    "execute": ("queries", "rollouts"),
    "safety": ("references", "rollouts", "within_limits"),
    "start": ("center", "radius"),
    "disturbance": ("radius",),
}
"""Keys of the sections that the stages read one by one."""


def require_sound_config(config: Mapping[str, Any], *, problem: bool = True) -> None:
    """Check that every section fits what it configures, that the problem is well posed and the partition is one.

    Args:
        config: resolved config.
        problem: whether to check the problem as well; a robot alone, without an experiment's sets, is none.

    Raises:
        ConfigError: one line with every complaint.
    """
    found = [*all_complaints(config), *_option_complaints(config)]
    if problem and not any(complaint.startswith("dynamics") for complaint in found):
        found += _problem_complaints(config)
    if found:
        raise ConfigError("; ".join(found))


def _option_complaints(config: Mapping[str, Any]) -> Iterator[str]:
    """Options of functions and of classes that the stages call by name."""
    expert = _without(config["expert"], "count", "processes", "weights")
    yield from option_complaints(Expert, expert, "expert", given=("dynamics", "scene", "horizon", "weights"))
    yield from option_complaints(Weights, config["expert"].get("weights"), "expert.weights")

    yield from _planner_complaints(config)

    if stage_named("train-dynamics").applies(config):
        yield from training_complaints(config)

    training = config["training"]
    given = ("tracker", "dynamics", "references", "start", "disturbance", "tube", *_RUN)
    yield from option_complaints(train_tracker, _without(training, "references", "tube"), "training", given=given)
    yield from option_complaints(LossWeights, training.get("weights"), "training.weights")
    if training.get("tube") is not None:
        yield from option_complaints(TubeLoss, training["tube"], "training.tube")

    yield from _source_complaints(config["sources"], str(config["name"]))
    given = ("verification", "dynamics", "tracker", "scene", *_RUN)
    yield from option_complaints(attack, config["verify"].get("falsifier"), "verify.falsifier", given=given)
    for section, known in _KEYS.items():
        for key in config[section]:
            if key not in known:
                near = did_you_mean(str(key), known) or f"; known: {', '.join(known)}"
                yield f"{section}.{key}: no such option{near}"


def _planner_complaints(config: Mapping[str, Any]) -> Iterator[str]:
    """Options of what trains the planner; where nothing does, ``planner_training`` is not looked at."""
    try:
        planner, training = target_class(config["planner"], "planner"), config["planner_training"]
    except ConfigError:
        return  # the section's own complaint
    learns_from = getattr(planner, "learns_from", None)
    if learns_from == "demonstrations":
        given = ("planner", "demonstrations", "held_out", "scene", "position", *_RUN)
        yield from option_complaints(train_planner, _without(training, "held_out"), "planner_training", given=given)
        given = ("planner", "demonstrations", "steps")
        yield from option_complaints(planner.loss_type, training.get("loss"), "planner_training.loss", given=given)
    elif learns_from == "scenes":
        yield from option_complaints(planner.learn, training, "planner_training", given=("self", "scene", *_RUN))
    elif learns_from != "nothing":
        yield f"planner._target_: {planner.__name__} is no planner: it does not say what it learns from"


def _source_complaints(sources: Any, own: str) -> Iterator[str]:
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
        if experiment not in experiments:
            near = did_you_mean(str(experiment), experiments) or f"; known: {', '.join(experiments)}"
            yield f"sources.{stage}: no experiment '{experiment}'{near}"
        elif experiment == own:
            yield f"sources.{stage}: {own} is this experiment itself"


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


def _without(section: Mapping[str, Any], *keys: str) -> dict[str, Any]:
    return {k: v for k, v in section.items() if k not in keys}
