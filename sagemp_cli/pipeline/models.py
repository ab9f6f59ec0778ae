"""Trained modules to records and back; a record is data, never code."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import nn

from sagemp_cli.config.binding import NAME, build, options_for, parameters_of, target_class
from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.dynamics.learned import Learned
from sagemp_cli.errors import ArtifactError, ConfigError
from sagemp_cli.learning.fit import History
from sagemp_cli.loop.controller import Controller
from sagemp_cli.planners.base import StoredPlanner
from sagemp_cli.planners.own import OwnPlanner
from sagemp_cli.plugins import KINDS
from sagemp_cli.reading.plain_json import plain_mapping
from sagemp_cli.storage import Artifact, DynamicsModel, PlannerModel, TrackerModel, TrainingCurve


def weights_of(module: nn.Module) -> dict[str, np.ndarray]:
    """Parameters and buffers by name."""
    return {name: value.detach().cpu().numpy().copy() for name, value in module.state_dict().items()}


def data_arguments(section: Mapping[str, Any], where: str, dynamics: Dynamics, horizon: int) -> dict[str, Any]:
    """Those constructor arguments of a section's class that come from the robot and the horizon."""
    known = {
        "state_dim": dynamics.state_dim,
        "state_names": list(dynamics.state_names),
        "control_dim": dynamics.control_dim,
        "horizon": horizon,
        "dt": dynamics.dt,
        "robot": dynamics,
    }
    wanted = parameters_of(target_class(section, where))
    return {key: known[key] for key in KINDS[where].from_data if key in wanted}


def planner_of(section: Mapping[str, Any], dynamics: Dynamics, horizon: int) -> StoredPlanner:
    """The planner of a config, which has learned nothing yet; of a plain function or object, that in a wrapper."""
    found = build(section, "planner", **data_arguments(section, "planner", dynamics, horizon))
    if hasattr(found, "learns_from"):
        return found
    return OwnPlanner(found, name=section[NAME], state_names=dynamics.state_names, horizon=horizon)


def planner_from(artifact: Artifact[PlannerModel]) -> StoredPlanner:
    """The trained planner, built from the artifact's own config.

    Raises:
        ArtifactError: what the file says is no planner.
    """
    config = artifact.header.config
    arguments = _arguments(artifact.record.arguments, artifact)
    try:
        section, horizon = config.get("planner", {}), config.get("horizon")
        if hasattr(target_class(section, "planner"), "learns_from"):
            module = build({**arguments, NAME: section[NAME]}, "planner")
        elif isinstance(horizon, int):
            module = planner_of(section, build(config.get("dynamics"), "dynamics"), horizon)
        else:
            raise ConfigError(f"horizon must be a whole number, found {horizon!r}")
    except ConfigError as e:
        raise ArtifactError(f"{artifact.path}: {e}") from None
    return _loaded(module, artifact.record.weights, artifact)


def robot_from(artifact: Artifact[DynamicsModel], robot: Learned) -> Learned:
    """A learned robot with the weights of the artifact, which are those of a robot of another section at your risk:
    only names and shapes are compared.
    """
    return _loaded(robot, artifact.record.weights, artifact)


def stand_in(config: Mapping[str, Any]) -> str:
    """What takes the place of the real thing in an experiment's plans, in a few words; empty if nothing does."""
    from_file = config.get("verify", {}).get("file") is not None
    said = getattr(target_class(config.get("planner"), "planner"), "stand_in", None)
    return "" if said is None or from_file else said(config["planner"])


def tracker_of(section: Mapping[str, Any], dynamics: Dynamics, horizon: int) -> tuple[Controller, dict[str, Any]]:
    """The tracker of a config, and the arguments from which it is made again with its weights.

    One that trains has its initial weights, which torch's generator draws; another is taken as it is, from its file if
    it has one.

    Raises:
        ConfigError: it is no controller, or not one of this robot.
    """
    extra = data_arguments(section, "tracker", dynamics, horizon)
    kind: Any = target_class(section, "tracker")
    given = {key: value for key, value in section.items() if key != NAME}
    taken = None if getattr(kind, "trains", True) else getattr(kind, "taken", None)
    if taken is None:
        made = build(section, "tracker", **extra)
    else:
        made = taken(**options_for(kind, given, "tracker", given=tuple(extra)), **extra)
    if not isinstance(made, Controller):
        raise ConfigError(
            f"tracker '{section[NAME]}' is no Controller (see docs/adding.md), found {type(made).__name__}"
        )
    if (made.state_dim, made.control_dim) != (dynamics.state_dim, dynamics.control_dim):
        raise ConfigError(
            f"tracker '{section[NAME]}' is for {made.state_dim} states and {made.control_dim} controls, "
            f"the robot has {dynamics.state_dim} and {dynamics.control_dim}"
        )
    plain = {key: value for key, value in extra.items() if key != "robot"}
    return made, made.arguments(given | plain)


def tracker_from(artifact: Artifact[TrackerModel]) -> Controller:
    """The trained tracker, of the kind that the artifact's config names.

    Raises:
        ArtifactError: what the file says is no tracker.
    """
    arguments, config = _arguments(artifact.record.arguments, artifact), artifact.header.config
    try:
        wanted = parameters_of(target_class(config.get("tracker"), "tracker"))
        robot = {"robot": build(config.get("dynamics"), "dynamics")} if "robot" in wanted else {}
        module = build({**arguments, NAME: config["tracker"][NAME]}, "tracker", **robot)
    except ConfigError as e:
        raise ArtifactError(f"{artifact.path}: {e}") from None
    return _loaded(module, artifact.record.weights, artifact)


def curve_of(history: History) -> TrainingCurve:
    """A training run's figures in one table: loss, what was reported beside it, validation figures."""
    steps = np.arange(len(history.loss), dtype=np.int64)
    columns = {"loss": history.loss, **{name: history.figures[name] for name in sorted(history.figures)}}
    for name, values in sorted(history.validation.items()):
        column = np.full(len(steps), np.nan)
        # A validation after v updates belongs to the last of them.
        column[np.asarray(history.validated_at) - 1] = values
        columns[f"validation {name}"] = column
    values = np.stack([np.asarray(column, dtype=np.float64) for column in columns.values()], axis=1)
    return TrainingCurve(step=steps, names=tuple(columns), values=values)


def figures_at_end(history: History) -> dict[str, float]:
    """A model card: the last validation's figures, and the last twentieth's mean of what every update measured."""
    tail = max(1, len(history.loss) // 20)
    figures = {"loss": float(np.mean(history.loss[-tail:]))}
    for name, values in sorted(history.figures.items()):
        measured = values[-tail:][np.isfinite(values[-tail:])]
        if len(measured):
            figures[name] = float(measured.mean())
    return figures | {name: float(values[-1]) for name, values in sorted(history.validation.items())}


_MOST_NUMBERS = 100


def _arguments(text: str, artifact: Artifact[Any]) -> dict[str, Any]:
    """Constructor arguments in an artifact: untrusted input, whose types the binding checks."""
    try:
        arguments = plain_mapping(text, "/data/arguments")
    except ValueError as e:
        raise ArtifactError(f"{artifact.path}: {e}") from None
    for key, value in arguments.items():
        if isinstance(value, list) and len(value) > _MOST_NUMBERS and isinstance(value[0], int | float):
            raise ArtifactError(
                f"{artifact.path}: /data/arguments: '{key}' has {len(value)} numbers, more than {_MOST_NUMBERS}"
            )
    return arguments


def _loaded(module: Any, weights: Mapping[str, np.ndarray], artifact: Artifact[Any]) -> Any:
    wanted = {name: tuple(value.shape) for name, value in module.state_dict().items()}
    found = {name: value.shape for name, value in weights.items()}
    if wanted != found:
        odd = next(k for k in {**wanted, **found} if wanted.get(k) != found.get(k))
        raise ArtifactError(
            f"{artifact.path}: weight '{odd}' has shape {found.get(odd)}, the model needs {wanted.get(odd)}"
        )
    module.load_state_dict({name: torch.from_numpy(np.array(value)) for name, value in weights.items()})
    return module.eval()
