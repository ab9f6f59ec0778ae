"""From config to the problem that is proved: robot, scene, start box, disturbance box, horizon."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sagemp_cli.config.binding import build
from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.dynamics.learned import Learned
from sagemp_cli.errors import ConfigError
from sagemp_cli.pipeline.context import StageContext
from sagemp_cli.pipeline.models import robot_from
from sagemp_cli.problem import Problem
from sagemp_cli.scenes.scene import scene_from_mapping
from sagemp_cli.sets import Between, Box
from sagemp_cli.storage import Artifact, DynamicsModel


def trained_problem(context: StageContext) -> tuple[Problem, tuple[Artifact[DynamicsModel], ...]]:
    """The problem of a stage's config, a learned robot with its weights, and the files that these came from.

    Raises:
        ConfigError: see :func:`problem_of`.
        ArtifactError: a learned robot's weights are missing or not its own.
    """
    problem = problem_of(context.config)
    if not isinstance(problem.dynamics, Learned):
        return problem, ()
    artifact = context.read("train-dynamics")
    robot_from(artifact, problem.dynamics)
    return problem, (artifact,)


def problem_of(config: Mapping[str, Any]) -> Problem:
    """Build the problem; every complaint is one line that names the key. A learned robot has no weights yet.

    Raises:
        ConfigError: a key is missing or has the wrong length, a number is NaN or infinite, a radius is negative,
            or the start box has zero width in every dimension (one rollout would do there).
    """
    dynamics = robot_of(config)
    names, n = dynamics.state_names, dynamics.state_dim
    scene = scene_from_mapping(config["scene"], state_dim=n, position_dim=len(dynamics.position))
    horizon = config["horizon"]
    if not isinstance(horizon, int) or isinstance(horizon, bool) or horizon < 1:
        raise ConfigError(f"horizon must be a positive whole number of steps, found {horizon!r}")
    center = _numbers("start.center", config["start"].get("center"), n)
    radius = _radius("start.radius", config["start"].get("radius"), names)
    if not any(radius):
        raise ConfigError(f"start.radius must be positive in at least one of {', '.join(names)}; found {radius}")
    disturbance = _radius("disturbance.radius", config["disturbance"].get("radius"), names)
    return Problem(
        dynamics=dynamics,
        scene=scene,
        start=Box.around(center, radius),
        disturbance=Box.around([0.0] * n, disturbance),
        horizon=horizon,
        between=Between.CONTINUOUS if dynamics.continuous else Between.SEGMENTS,
    )


def robot_of(config: Mapping[str, Any]) -> Dynamics:
    """The robot of a config; a learned one has no weights yet."""
    return build(config["dynamics"], "dynamics")


def _radius(where: str, values: Any, names: tuple[str, ...]) -> list[float]:
    radius = _numbers(where, values, len(names))
    for name, value in zip(names, radius, strict=True):
        if value < 0:
            raise ConfigError(f"{where} must not be negative, found {value} for {name}")
    return radius


def _numbers(where: str, values: Any, size: int) -> list[float]:
    if not isinstance(values, list | tuple):
        raise ConfigError(f"{where} must be a list of {size} numbers, found {values!r}")
    if len(values) != size:
        raise ConfigError(f"{where} needs {size} numbers, found {len(values)}")
    try:
        numbers = [float(v) for v in values]
    except (TypeError, ValueError):
        raise ConfigError(f"{where} must be a list of {size} numbers, found {values!r}") from None
    if not all(abs(v) < float("inf") for v in numbers):  # false for NaN too
        raise ConfigError(f"{where} must hold finite numbers, found {values!r}")
    return numbers
