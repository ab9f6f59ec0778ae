"""``sagemp execute``: Algorithm 3, the closest certified reference tracked under disturbances."""

from __future__ import annotations

from pathlib import Path

from sagemp_cli.execution import execute_queries
from sagemp_cli.models import planner_from, tracker_from
from sagemp_cli.report.figure import draw_beside
from sagemp_cli.report.rollouts import draw_rollouts
from sagemp_cli.stages.options import whole_number
from sagemp_cli.stages.problem import trained_problem
from sagemp_cli.stages.stage import StageContext
from sagemp_cli.stages.tubes import verification_of
from sagemp_cli.storage import Rollouts


def run(context: StageContext) -> Path:
    """Measure starts in X_I, ask the planner, track the closest certified reference, and watch the tube."""
    (problem, robot_files), section = trained_problem(context), context.config["execute"]
    queries = whole_number(section["queries"], "execute.queries")
    rollouts = whole_number(section["rollouts"], "execute.rollouts")
    planner_file, tracker_file = context.read("train-planner"), context.read("train-tracker")
    library_file = context.read("build-library")
    planner, tracker = planner_from(planner_file), tracker_from(tracker_file)
    sampling = context.generator("execute: planner")
    done = execute_queries(
        verification_of(library_file.record.tubes, str(library_file.path)),
        lambda starts: planner.sample(
            starts, problem.scene.goal, scene=problem.scene, count=len(starts), generator=sampling
        ),
        dynamics=problem.dynamics,
        tracker=tracker,
        scene=problem.scene,
        starts=problem.start.sample(queries, context.generator("execute: starts")),
        rollouts=rollouts,
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
    path = context.write("execute", record, (planner_file, tracker_file, library_file, *robot_files))
    draw_beside(path, draw_rollouts, context.read("execute"), library_file)
    return path
