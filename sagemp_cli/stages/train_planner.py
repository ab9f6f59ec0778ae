"""``sagemp train-planner``: the generative planner, on what it learns from."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sagemp_cli.binding import build
from sagemp_cli.errors import ConfigError
from sagemp_cli.models import curve_of, data_arguments, figures_at_end, weights_of
from sagemp_cli.planners import (
    LearnedPlanner,
    SelfTaughtPlanner,
    StoredPlanner,
    affordable,
    open_loop_figures,
    side_shares,
    train_planner,
)
from sagemp_cli.report.figure import draw_beside
from sagemp_cli.report.planner import draw_planner
from sagemp_cli.stages.options import options_for
from sagemp_cli.stages.partial import PartialFile
from sagemp_cli.stages.problem import Problem, problem_of
from sagemp_cli.stages.stage import StageContext
from sagemp_cli.storage import Artifact, Parent, PlannerModel, sha256_of
from sagemp_cli.training import History

TRAJECTORIES = "trajectories"
"""Role of a file of trajectories among the planner's parents."""

_RUN = ("generator", "checkpoint", "identity", "progress")
_PLANS = 200
"""Plans that the model card of a planner without demonstrations is about, if it can afford them."""


@dataclass(frozen=True)
class _Outcome:
    """What came of a planner's training."""

    history: History
    figures: dict[str, float]
    partial: PartialFile | None = None
    parents: tuple[Artifact[Any], ...] = ()
    files: tuple[Parent, ...] = ()


def run(context: StageContext) -> Path:
    """Build the planner, let it learn from what it learns from, and write it with its model card."""
    problem = problem_of(context.config)
    planner: StoredPlanner = build(
        context.config["planner"],
        "planner",
        **data_arguments(context.config["planner"], "planner", problem.dynamics, problem.horizon),
    )
    learn = {"demonstrations": _from_demonstrations, "scenes": _from_scenes, "nothing": _as_it_is}
    outcome = learn[planner.learns_from](context, problem, planner)
    figures = {"parameters": float(sum(p.numel() for p in planner.parameters()))} | outcome.figures
    record = PlannerModel(
        weights=weights_of(planner),
        arguments=json.dumps(planner.arguments),
        curve=curve_of(outcome.history),
        figure_names=tuple(figures),
        figures=np.array(list(figures.values())),
    )
    path = context.write("train-planner", record, outcome.parents, outcome.files)
    if outcome.partial is not None:
        outcome.partial.remove()
    draw_beside(path, draw_planner, context.read("train-planner"))
    return path


def _from_demonstrations(context: StageContext, problem: Problem, planner: LearnedPlanner) -> _Outcome:
    """Train on the demonstrations except the last ones, which are held out for the validation curve."""
    section = dict(context.config["planner_training"])
    share = section.pop("held_out", 0.1)
    if not isinstance(share, float) or not 0 < share < 1:
        raise ConfigError(f"planner_training.held_out must be a share in (0, 1), found {share!r}")
    given = ("planner", "demonstrations", "held_out", "scene", "position", *_RUN)
    options = options_for(train_planner, section, "planner_training", given=given)
    options_for(
        planner.loss_type, options.get("loss"), "planner_training.loss", given=("planner", "demonstrations", "steps")
    )
    source = context.read("gen-data")
    states = torch.from_numpy(source.record.states)
    kept = len(states) - math.ceil(share * len(states))
    if kept < 1:
        raise ConfigError(f"{source.path}: {len(states)} demonstrations are too few to hold some out; set expert.count")
    about = {"scene": problem.scene, "position": problem.dynamics.position}
    partial = PartialFile.of(context, "train-planner", parents=(source.as_parent("demonstrations", context.folder),))
    history = train_planner(
        planner,
        states[:kept],
        held_out=states[kept:],
        generator=context.generator("train-planner"),
        checkpoint=partial.path,
        identity=partial.identity,
        progress=context.progress,
        **about,
        **options,
    )
    shown = {f"demonstrated share {label}": s for label, s in sorted(side_shares(states[:kept], **about).items())}
    return _Outcome(history, {"demonstrations": float(kept)} | figures_at_end(history) | shown, partial, (source,))


def _from_scenes(context: StageContext, problem: Problem, planner: SelfTaughtPlanner) -> _Outcome:
    """Let the planner make its own lessons; ``planner_training`` are the options of its ``learn``."""
    options = options_for(planner.learn, context.config["planner_training"], "planner_training", given=("scene", *_RUN))
    partial = PartialFile.of(context, "train-planner")
    history = planner.learn(
        scene=problem.scene,
        generator=context.generator("train-planner"),
        checkpoint=partial.path,
        identity=partial.identity,
        progress=context.progress,
        **options,
    )
    return _Outcome(history, figures_at_end(history) | _card(context, problem, planner), partial)


def _as_it_is(context: StageContext, problem: Problem, planner: StoredPlanner) -> _Outcome:
    """Nothing is trained; what the planner did to the file that it read is said."""
    for note in getattr(planner, "notes", ()):
        context.progress.say(f"planner: {note}")
    source: Path | None = getattr(planner, "source", None)
    files = (
        () if source is None else (Parent(TRAJECTORIES, os.path.relpath(source, context.folder), sha256_of(source)),)
    )
    nothing = History(loss=np.zeros(0), figures={}, validated_at=np.zeros(0, dtype=np.int64), validation={})
    return _Outcome(nothing, _card(context, problem, planner), files=files)


def _card(context: StageContext, problem: Problem, planner: StoredPlanner) -> dict[str, float]:
    """Figures of plans from starts drawn in X_I."""
    generator = context.generator("train-planner: model card")
    return open_loop_figures(
        planner,
        problem.start.sample(affordable(planner, _PLANS), generator),
        scene=problem.scene,
        position=problem.dynamics.position,
        generator=generator,
    )
