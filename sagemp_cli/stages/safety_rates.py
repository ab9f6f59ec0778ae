"""``sagemp safety-rates``: the paper's surrogate for what certification brings.

References are sampled from the planner as for a library; of each the stage asks whether it is safe from all of X_I when
its controls are played back, when it is tracked, and whether that is certified.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sagemp_cli.config.binding import Binding
from sagemp_cli.config.ranges import Count, Whole
from sagemp_cli.execution import DISTURBANCES, require_certified_safe, try_references
from sagemp_cli.execution import Trials as Found
from sagemp_cli.pipeline.context import StageContext
from sagemp_cli.pipeline.models import planner_from, tracker_from
from sagemp_cli.pipeline.partial import PartialResults
from sagemp_cli.pipeline.problem import trained_problem
from sagemp_cli.pipeline.proof import Proof
from sagemp_cli.pipeline.reference_starts import reference_starts
from sagemp_cli.report.figure import draw_beside
from sagemp_cli.report.safety import draw_safety
from sagemp_cli.stages import build_library
from sagemp_cli.storage import SafetyRates, Trials


@dataclass(frozen=True)
class Options:
    """The section ``safety``.

    Attributes:
        references: sampled from the planner.
        rollouts: starts per reference under each kind of disturbances.
        seed: of what is sampled.
        within_limits: whether the controls that are played back are clamped into the robot's limits.
    """

    references: Count
    rollouts: Count
    seed: Whole
    within_limits: bool


SECTIONS = (Binding("safety", Options), build_library.SECTIONS[0])


def run(context: StageContext) -> Path:
    """Sample references, execute each in both ways, prove what can be proved of them, compare.

    Finished chunks of the proof are kept until the output is written: an interrupted run goes on from there.

    Raises:
        UsageError: the robot has no inverse.
        SoundnessError: a rollout breaks what was certified; nothing is written.
    """
    (problem, robot_files), section = trained_problem(context), SECTIONS[0].made(context.config)
    count = section.references
    spread = SECTIONS[1].made(context.config).start_spread
    starts, proof = reference_starts(problem, spread), Proof.of(context.config, problem)
    planner_file, tracker_file = context.read("train-planner"), context.read("train-tracker")
    tracker, generator = tracker_from(tracker_file), context.generator("safety-rates: references")
    references = planner_from(planner_file).sample(
        starts.sample(count, generator), problem.scene.goal, scene=problem.scene, count=count, generator=generator
    )
    tried = try_references(
        references,
        problem,
        tracker=tracker,
        rollouts=section.rollouts,
        generator=context.generator("safety-rates: rollouts"),
        within_limits=section.within_limits,
        progress=context.progress,
    )
    inputs = (planner_file, tracker_file, *robot_files)
    beside = ("safety.rollouts", "safety.within_limits")  # no piece of the proof depends on them
    pieces = PartialResults.of(context, "safety-rates", inputs, without=beside)
    proved = proof.verify(references, tracker, pieces=pieces, progress=context.progress)
    require_certified_safe(proved.safe, tried.closed_loop)
    tubes = [proved.cells_of(r)[1].hull() for r in range(count)]
    record = SafetyRates(
        references=references.numpy(),
        controls=tried.inverse.controls.numpy(),
        residual=tried.inverse.residual.square().mean(1).sqrt().numpy(),
        disturbances=DISTURBANCES,
        open_loop=_trials(tried.open_loop),
        closed_loop=_trials(tried.closed_loop),
        verdict=tuple(str(v.outcome) for v in proved.verdicts),
        step=np.array([v.step for v in proved.verdicts], dtype=np.int64),
        fraction=np.array([v.fraction for v in proved.verdicts]),
        constraint=tuple(v.constraint for v in proved.verdicts),
        tube_lower=np.stack([tube.lower.numpy() for tube in tubes]),
        tube_upper=np.stack([tube.upper.numpy() for tube in tubes]),
        seconds=proved.seconds.numpy(),
        propagator=proved.propagator,
        rigorous=proved.rigorous,
    )
    path = context.write("safety-rates", record, inputs)
    pieces.remove()
    return path


def draw(context: StageContext) -> Path:
    """Draw the figure of what is there."""
    return draw_beside(context.output_path("safety-rates"), draw_safety, context.read("safety-rates"))


def _trials(found: Found) -> Trials:
    """As stored."""
    return Trials(clearance=found.clearance.numpy(), reached=found.reached.numpy(), nearest=found.nearest.numpy())
