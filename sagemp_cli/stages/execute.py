"""``sagemp execute``: Algorithm 3, the closest certified reference tracked under disturbances."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sagemp_cli.execution import execute_queries
from sagemp_cli.pipeline.context import StageContext
from sagemp_cli.pipeline.models import planner_from, tracker_from
from sagemp_cli.pipeline.options import key_complaints, number_complaints
from sagemp_cli.pipeline.problem import trained_problem
from sagemp_cli.pipeline.tubes import verification_of
from sagemp_cli.report.figure import draw_beside
from sagemp_cli.report.rollouts import draw_rollouts
from sagemp_cli.storage import Rollouts


def run(context: StageContext) -> Path:
    """Measure starts in X_I, ask the planner, track the closest certified reference, and watch the tube."""
    (problem, robot_files), section = trained_problem(context), context.config["execute"]
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
        starts=problem.start.sample(section["queries"], context.generator("execute: starts")),
        rollouts=section["rollouts"],
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


def complaints(config: Mapping[str, Any]) -> list[str]:
    """What is wrong with the section ``execute``."""
    least = {"queries": 1, "rollouts": 1, "seed": 0}
    section = config["execute"]
    return [*key_complaints(section, "execute", tuple(least)), *number_complaints(section, "execute", **least)]
