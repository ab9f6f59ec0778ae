"""``sagemp train-tracker``: one tracking policy for all references of the planner."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sagemp_cli.config.binding import Binding
from sagemp_cli.config.ranges import Count
from sagemp_cli.learning.fit import History
from sagemp_cli.loop.controller import Controller
from sagemp_cli.pipeline.context import StageContext
from sagemp_cli.pipeline.models import curve_of, figures_at_end, planner_from, tracker_of, weights_of
from sagemp_cli.pipeline.partial import PartialFile
from sagemp_cli.pipeline.problem import trained_problem
from sagemp_cli.report.figure import draw_beside
from sagemp_cli.report.training import draw_training
from sagemp_cli.storage import TrackerModel
from sagemp_cli.trackers.training import TrackerTrainingOptions, train_tracker


@dataclass(frozen=True, kw_only=True)
class Options(TrackerTrainingOptions):
    """The section ``tracker_training``.

    Attributes:
        references: sampled from the planner to train on.
    """

    references: Count


SECTIONS = (Binding("tracker_training", Options),)

_NOTHING_LEARNED = History(np.zeros(0), {}, np.zeros(0, np.int64), {})


def run(context: StageContext) -> Path:
    """Train on references of the planner, starts and disturbances of the sets that will be verified.

    A tracker that was trained elsewhere is taken as it is.
    """
    (problem, robot_files), options = trained_problem(context), SECTIONS[0].made(context.config)
    count = options.references
    with torch.random.fork_rng(devices=[]):  # initial weights depend on the root seed, whatever was drawn before
        torch.manual_seed(context.generator("train-tracker: initial weights").initial_seed())
        tracker, arguments = tracker_of(context.config["tracker"], problem.dynamics, problem.horizon)
    if not tracker.trains:
        sources = tuple(context.source("network", file) for file in tracker.files())
        return context.write("train-tracker", _record(tracker, arguments, _NOTHING_LEARNED), sources)
    planner_file = context.read("train-planner")
    planner = planner_from(planner_file)

    drawing = context.generator("train-tracker: references")
    references = planner.sample(
        problem.start.sample(count, drawing), problem.scene.goal, scene=problem.scene, count=count, generator=drawing
    )
    inputs = (planner_file, *robot_files)
    partial = PartialFile.of(context, "train-tracker", inputs)
    history = train_tracker(
        tracker,
        problem,
        options,
        references=references,
        generator=context.generator("train-tracker"),
        resumable=partial.resumable,
        progress=context.progress,
    )
    path = context.write("train-tracker", _record(tracker, arguments, history), inputs)
    partial.remove()
    return path


def _record(tracker: Controller, arguments: dict[str, Any], history: History) -> TrackerModel:
    figures = figures_at_end(history) if len(history.loss) else {}
    return TrackerModel(
        weights=weights_of(tracker),
        arguments=json.dumps(arguments),
        curve=curve_of(history),
        figure_names=tuple(figures),
        figures=np.array(list(figures.values()), dtype=np.float64),
    )


def draw(context: StageContext) -> Path | None:
    """Draw the figure of what is there; there is none of a tracker that was trained elsewhere."""
    artifact = context.read("train-tracker")
    if not len(artifact.record.curve.step):
        return None
    return draw_beside(context.output_path("train-tracker"), draw_training, artifact)
