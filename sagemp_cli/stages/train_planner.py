"""``sagemp train-planner``: the generative planner, on the expert's demonstrations."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import torch

from sagemp_cli.binding import build
from sagemp_cli.errors import ConfigError
from sagemp_cli.models import curve_of, data_arguments, figures_at_end, weights_of
from sagemp_cli.planners import train_planner
from sagemp_cli.report.figure import draw_beside
from sagemp_cli.report.planner import draw_planner
from sagemp_cli.stages.options import options_for
from sagemp_cli.stages.partial import PartialFile
from sagemp_cli.stages.problem import problem_of
from sagemp_cli.stages.stage import StageContext
from sagemp_cli.storage import PlannerModel


def run(context: StageContext) -> Path:
    """Train on the demonstrations except the last ones, which are held out for the validation curve."""
    problem, section = problem_of(context.config), dict(context.config["planner_training"])
    share = section.pop("held_out", 0.1)
    if not isinstance(share, float) or not 0 < share < 1:
        raise ConfigError(f"planner_training.held_out must be a share in (0, 1), found {share!r}")
    planner = build(
        context.config["planner"],
        "planner",
        **data_arguments(context.config["planner"], "planner", problem.dynamics, problem.horizon),
    )
    given = ("planner", "demonstrations", "held_out", "scene", "position", "generator", "checkpoint", "identity")
    options = options_for(train_planner, section, "planner_training", given=(*given, "progress"))
    options_for(
        planner.loss_type, options.get("loss"), "planner_training.loss", given=("planner", "demonstrations", "steps")
    )
    source = context.read("gen-data")
    states = torch.from_numpy(source.record.states)
    kept = len(states) - math.ceil(share * len(states))
    if kept < 1:
        raise ConfigError(f"{source.path}: {len(states)} demonstrations are too few to hold some out; set expert.count")
    partial = PartialFile.of(context, "train-planner", parents=(source.as_parent("demonstrations", context.folder),))
    history = train_planner(
        planner,
        states[:kept],
        held_out=states[kept:],
        scene=problem.scene,
        position=problem.dynamics.position,
        generator=context.generator("train-planner"),
        checkpoint=partial.path,
        identity=partial.identity,
        progress=context.progress,
        **options,
    )
    figures = {"demonstrations": float(kept)} | figures_at_end(history)
    record = PlannerModel(
        weights=weights_of(planner),
        arguments=json.dumps(planner.arguments),
        curve=curve_of(history),
        figure_names=tuple(figures),
        figures=np.array(list(figures.values())),
    )
    path = context.write("train-planner", record, (source,))
    partial.remove()
    draw_beside(path, draw_planner, context.read("train-planner"))
    return path
