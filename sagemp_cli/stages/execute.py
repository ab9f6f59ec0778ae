"""``sagemp execute``: Algorithm 3, the closest certified reference tracked under disturbances."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sagemp_cli.config.binding import Binding
from sagemp_cli.config.ranges import Count, Whole
from sagemp_cli.execution import execute_queries
from sagemp_cli.pipeline.context import StageContext
from sagemp_cli.pipeline.models import planner_from, tracker_from
from sagemp_cli.pipeline.problem import trained_problem
from sagemp_cli.pipeline.tubes import verification_of
from sagemp_cli.report.figure import draw_beside
from sagemp_cli.report.rollouts import draw_rollouts
from sagemp_cli.storage import Rollouts


@dataclass(frozen=True)
class Options:
    """The section ``execute``.

    Attributes:
        queries: starts measured in X_I.
        rollouts: disturbance sequences per query.
        seed: of what is sampled.
    """

    queries: Count
    rollouts: Count
    seed: Whole


SECTIONS = (Binding("execute", Options),)


def run(context: StageContext) -> Path:
    """Measure starts in X_I, ask the planner, track the closest certified reference, and watch the tube."""
    (problem, robot_files), section = trained_problem(context), SECTIONS[0].made(context.config)
    planner_file, tracker_file = context.read("train-planner"), context.read("train-tracker")
    library_file = context.read("build-library")
    planner, tracker = planner_from(planner_file), tracker_from(tracker_file)
    sampling = context.generator("execute: planner")
    done = execute_queries(
        verification_of(library_file.record.tubes, str(library_file.path)),
        lambda starts: planner.sample(
            starts, problem.scene.goal, scene=problem.scene, count=len(starts), generator=sampling
        ),
        problem=problem,
        tracker=tracker,
        starts=problem.start.sample(section.queries, context.generator("execute: starts")),
        rollouts=section.rollouts,
        generator=context.generator("execute: disturbances"),
        progress=context.progress,
    )
    record = Rollouts(
        sampled_references=done.sampled.numpy(),
        chosen=done.chosen.numpy(),
        reference_error=done.error.numpy(),
        query=done.query.numpy(),
        states=done.states.numpy(),
        controls=done.controls.numpy(),
        disturbances=done.disturbances.numpy(),
        in_tube=done.in_tube.numpy(),
        safe=done.safe.numpy(),
    )
    return context.write("execute", record, (planner_file, tracker_file, library_file, *robot_files))


def draw(context: StageContext) -> Path:
    """Draw the figure of what is there."""
    return draw_beside(
        context.output_path("execute"), draw_rollouts, context.read("execute"), context.read("build-library")
    )
