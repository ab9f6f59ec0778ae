"""``sagemp build-library``: Algorithm 2, references sampled until enough are certified."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from torch import Tensor

from sagemp_cli.config.binding import Binding
from sagemp_cli.config.ranges import Count, NonNegative, Whole
from sagemp_cli.errors import ConfigError
from sagemp_cli.library import REASONS, Fill, build_library
from sagemp_cli.pipeline.context import StageContext
from sagemp_cli.pipeline.loop_record import loop_record
from sagemp_cli.pipeline.models import planner_from, tracker_from
from sagemp_cli.pipeline.problem import trained_problem
from sagemp_cli.pipeline.proof import Proof
from sagemp_cli.pipeline.reference_starts import XIShare, reference_starts
from sagemp_cli.pipeline.tubes import tubes_record
from sagemp_cli.report.figure import draw_beside
from sagemp_cli.report.library import draw_library
from sagemp_cli.storage import Library
from sagemp_cli.verification.attack.refutation import attack


@dataclass(frozen=True)
class Options:
    """The section ``library``.

    Attributes:
        size: certified references wanted, C.
        budget: references sampled at most.
        seed: of what is sampled.
        start_spread: share of X_I that they start in.
        batch: references drawn and proved at a time.
        apart: metres; references that are at every step closer than this to an entry repeat it and are not taken.
        fill: which certified references are taken.
    """

    size: Count
    budget: Count
    seed: Whole
    start_spread: XIShare
    batch: Count
    apart: NonNegative
    fill: Literal["first", "modes"]

    def __post_init__(self) -> None:
        if self.budget < self.size:
            raise ConfigError(f"library.budget must be at least library.size, {self.size}; found {self.budget}")


SECTIONS = (Binding("library", Options),)


def run(context: StageContext) -> Path:
    """Sample, reject or certify, attack what was certified, write the library."""
    (problem, robot_files), section = trained_problem(context), SECTIONS[0].made(context.config)
    starts, proof = reference_starts(problem, section.start_spread), Proof.of(context.config, problem)
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
        wanted=section.size,
        budget=section.budget,
        batch=section.batch,
        apart=section.apart,
        fill=Fill(section.fill),
        progress=context.progress,
    )
    attack(
        made.certified,
        problem,
        tracker=tracker,
        generator=context.generator("build-library: falsifier"),
        progress=context.progress,
    )
    for line in made.coverage.lines():
        context.progress.say(line)
    record = Library(
        tubes=tubes_record(made.certified),
        loop=loop_record(problem, tracker),
        rejected_references=made.rejected.numpy(),
        rejected_reason=made.reasons,
        reason_names=REASONS,
        reason_counts=np.array(made.counts, dtype=np.int64),
        sampled=made.sampled,
        wanted=section.size,
        mode=made.modes,
        mode_names=made.coverage.names,
        mode_drawn=np.array(made.coverage.drawn, dtype=np.int64),
    )
    return context.write("build-library", record, (planner_file, tracker_file, *robot_files))


def draw(context: StageContext) -> Path:
    """Draw the figure of what is there."""
    return draw_beside(context.output_path("build-library"), draw_library, context.read("build-library"))
