"""``sagemp train-planner``: the generative planner, on what it learns from."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from sagemp_cli.config.binding import Binding, target_class
from sagemp_cli.config.ranges import Fraction
from sagemp_cli.errors import ConfigError
from sagemp_cli.learning.fit import History
from sagemp_cli.pipeline.context import StageContext
from sagemp_cli.pipeline.models import curve_of, figures_at_end, planner_of, weights_of
from sagemp_cli.pipeline.partial import PartialFile
from sagemp_cli.pipeline.problem import problem_of
from sagemp_cli.planners import (
    LearnedPlanner,
    PlannerTrainingOptions,
    SelfTaughtPlanner,
    StoredPlanner,
    affordable,
    open_loop_figures,
    side_shares,
    train_planner,
)
from sagemp_cli.problem import Problem
from sagemp_cli.report.figure import draw_beside
from sagemp_cli.report.planner import draw_planner
from sagemp_cli.storage import Artifact, Parent, PlannerModel

TRAJECTORIES = "trajectories"
"""Role of a file of trajectories among the planner's parents."""

_PLANS = 200
"""Plans that the model card of a planner without demonstrations is about, if it can afford them."""


@dataclass(frozen=True, kw_only=True)
class Options(PlannerTrainingOptions):
    """The section ``planner_training`` of planners that learn from demonstrations.

    Attributes:
        held_out: share of the demonstrations that is kept back for the validation curve.
    """

    held_out: Fraction


@dataclass(frozen=True)
class _Outcome:
    """What came of a planner's training."""

    history: History
    figures: dict[str, float]
    partial: PartialFile | None = None
    inputs: tuple[Artifact[Any] | Parent, ...] = ()


def run(context: StageContext) -> Path:
    """Build the planner, let it learn from what it learns from, and write it with its model card."""
    problem = problem_of(context.config)
    planner = planner_of(context.config["planner"], problem.dynamics, problem.horizon)
    assert isinstance(planner, nn.Module)
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
    path = context.write("train-planner", record, outcome.inputs)
    if outcome.partial is not None:
        outcome.partial.remove()
    return path


def draw(context: StageContext) -> Path:
    """Draw the figure of what is there."""
    return draw_beside(context.output_path("train-planner"), draw_planner, context.read("train-planner"))


def sections(config: Mapping[str, Any]) -> tuple[Binding, ...]:
    """What ``planner_training`` is bound to, by what the planner learns from; nothing where it learns nothing."""
    planner: Any = target_class(config["planner"], "planner")
    learns_from = getattr(planner, "learns_from", "nothing")
    if learns_from == "demonstrations":
        return (
            Binding("planner_training", Options),
            Binding("planner_training.loss", planner.loss_type, given=("planner", "demonstrations", "steps")),
        )
    if learns_from == "scenes":
        return (Binding("planner_training", planner.options_type),)
    return ()


def _from_demonstrations(context: StageContext, problem: Problem, planner: LearnedPlanner) -> _Outcome:
    """Train on the demonstrations except the last ones, which are held out for the validation curve."""
    options: Options = sections(context.config)[0].made(context.config)
    source = context.read("gen-data")
    states = torch.from_numpy(source.record.states)
    kept = len(states) - math.ceil(options.held_out * len(states))
    if kept < 1:
        raise ConfigError(f"{source.path}: {len(states)} demonstrations are too few to hold some out; set expert.count")
    partial = PartialFile.of(context, "train-planner", (source,))
    history = train_planner(
        planner,
        states[:kept],
        held_out=states[kept:],
        problem=problem,
        options=options,
        generator=context.generator("train-planner"),
        resumable=partial.resumable,
        progress=context.progress,
    )
    shares = side_shares(states[:kept], scene=problem.scene, position=problem.dynamics.position)
    shown = {f"demonstrated share {label}": share for label, share in sorted(shares.items())}
    return _Outcome(history, {"demonstrations": float(kept)} | figures_at_end(history) | shown, partial, (source,))


def _from_scenes(context: StageContext, problem: Problem, planner: SelfTaughtPlanner) -> _Outcome:
    """Let the planner make its own lessons."""
    partial = PartialFile.of(context, "train-planner")
    history = planner.learn(
        sections(context.config)[0].made(context.config),
        scene=problem.scene,
        generator=context.generator("train-planner"),
        resumable=partial.resumable,
        progress=context.progress,
    )
    return _Outcome(history, figures_at_end(history) | _card(context, problem, planner), partial)


def _as_it_is(context: StageContext, problem: Problem, planner: StoredPlanner) -> _Outcome:
    """Nothing is trained; what the planner did to the file that it read is said."""
    for note in getattr(planner, "notes", ()):
        context.progress.say(f"planner: {note}")
    source: Path | None = getattr(planner, "source", None)
    inputs = () if source is None else (context.source(TRAJECTORIES, source),)
    nothing = History(loss=np.zeros(0), figures={}, validated_at=np.zeros(0, dtype=np.int64), validation={})
    return _Outcome(nothing, _card(context, problem, planner), inputs=inputs)


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
