"""``sagemp train-dynamics``: a learned robot's network, on transitions of its analytical model."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sagemp_cli.config.binding import Binding
from sagemp_cli.dynamics.learned import Learned
from sagemp_cli.errors import ConfigError
from sagemp_cli.identification import DynamicsTrainingOptions, learn_dynamics
from sagemp_cli.pipeline.context import StageContext
from sagemp_cli.pipeline.models import curve_of, figures_at_end, weights_of
from sagemp_cli.pipeline.partial import PartialFile
from sagemp_cli.pipeline.problem import robot_of
from sagemp_cli.report.dynamics import draw_dynamics
from sagemp_cli.report.figure import draw_beside
from sagemp_cli.storage import DynamicsModel

SECTIONS = (Binding("dynamics_training", DynamicsTrainingOptions),)


def run(context: StageContext) -> Path:
    """Draw transitions of the analytical model and learn from them; no other file is read.

    Raises:
        ConfigError: the config's robot is not a learned one, or an option is not one.
    """
    robot = robot_of(context.config)
    if not isinstance(robot, Learned):
        raise ConfigError(
            f"dynamics: {type(robot).__name__} has nothing to learn; "
            f"choose a learned robot, e.g. dynamics=unicycle_learned"
        )
    partial = PartialFile.of(context, "train-dynamics")
    history, errors = learn_dynamics(
        robot,
        SECTIONS[0].made(context.config),
        generator=context.generator("train-dynamics"),
        resumable=partial.resumable,
        progress=context.progress,
    )
    figures = figures_at_end(history) | {"parameters": float(sum(p.numel() for p in robot.parameters()))}
    record = DynamicsModel(
        weights=weights_of(robot),
        curve=curve_of(history),
        figure_names=tuple(figures),
        figures=np.array(list(figures.values())),
        error_rms=errors.rms,
        error_max=errors.largest,
        error_edges=errors.edges,
        error_counts=errors.counts,
    )
    path = context.write("train-dynamics", record)
    partial.remove()
    return path


def draw(context: StageContext) -> Path:
    """Draw the figure of what is there."""
    return draw_beside(context.output_path("train-dynamics"), draw_dynamics, context.read("train-dynamics"))
