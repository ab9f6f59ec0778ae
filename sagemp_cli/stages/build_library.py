"""``sagemp build-library``: Algorithm 2, references sampled until enough are certified."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from sagemp_cli.library import REASONS, build_library
from sagemp_cli.pipeline.context import StageContext
from sagemp_cli.pipeline.models import planner_from, tracker_from
from sagemp_cli.pipeline.options import is_whole, key_complaints, number_complaints
from sagemp_cli.pipeline.problem import trained_problem
from sagemp_cli.pipeline.proof import Proof
from sagemp_cli.pipeline.reference_starts import reference_starts, spread_complaints
from sagemp_cli.pipeline.tubes import tubes_record
from sagemp_cli.report.figure import draw_beside
from sagemp_cli.report.library import draw_library
from sagemp_cli.storage import Library
from sagemp_cli.verification.attack.refutation import attack


def run(context: StageContext) -> Path:
    """Sample, reject or certify, attack what was certified, write the library."""
    (problem, robot_files), section = trained_problem(context), context.config["library"]
    starts, proof = reference_starts(context.config, problem), Proof.of(context.config, problem)
    planner_file, tracker_file = context.read("train-planner"), context.read("train-tracker")
    planner, tracker = planner_from(planner_file), tracker_from(tracker_file)

    generator = context.generator("build-library: references")

    def draw(count: int) -> Tensor:
        return planner.sample(
            starts.sample(count, generator), problem.scene.goal, scene=problem.scene, count=count, generator=generator
        )

    made = build_library(
        draw,
        lambda references: proof.verify(references, tracker),
        scene=problem.scene,
        position=problem.dynamics.position,
        wanted=section["size"],
        budget=section["budget"],
        progress=context.progress,
    )
    attack(
        made.certified,
        problem.dynamics,
        tracker=tracker,
        scene=problem.scene,
        generator=context.generator("build-library: falsifier"),
        progress=context.progress,
    )
    record = Library(
        tubes=tubes_record(made.certified),
        tracker=tracker_file.record.weights,
        tracker_arguments=tracker_file.record.arguments,
        rejected_references=made.rejected.numpy(),
        rejected_reason=made.reasons,
        reason_names=REASONS,
        reason_counts=np.array(made.counts, dtype=np.int64),
        sampled=made.sampled,
        wanted=section["size"],
        dynamics=robot_files[0].record.weights if robot_files else None,
    )
    path = context.write("build-library", record, (planner_file, tracker_file, *robot_files))
    draw_beside(path, draw_library, context.read("build-library"))
    return path


def complaints(config: Mapping[str, Any]) -> list[str]:
    """What is wrong with the section ``library``."""
    section = config["library"]
    least = section["size"] if is_whole(section.get("size"), 1) else 1
    return [
        *key_complaints(section, "library", ("size", "budget", "seed", "start_spread")),
        *number_complaints(section, "library", size=1, budget=least, seed=0),
        *spread_complaints(config),
    ]
