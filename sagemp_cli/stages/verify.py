"""``sagemp verify``: references of the planner or of a file, their tubes, the verdict, and an attack on it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sagemp_cli.config.binding import Binding
from sagemp_cli.config.ranges import Count, Whole
from sagemp_cli.pipeline.context import StageContext
from sagemp_cli.pipeline.loop_record import loop_record
from sagemp_cli.pipeline.models import planner_from, tracker_from
from sagemp_cli.pipeline.partial import PartialResults
from sagemp_cli.pipeline.problem import trained_problem
from sagemp_cli.pipeline.proof import Proof
from sagemp_cli.pipeline.reference_file import read_references
from sagemp_cli.pipeline.sample_share import sample_share
from sagemp_cli.pipeline.true_model import SECTION as TRUE_MODEL
from sagemp_cli.pipeline.true_model import TrueModelProof
from sagemp_cli.pipeline.tubes import counterexample_record, tubes_record
from sagemp_cli.planners.from_file import FromFile
from sagemp_cli.planners.trajectory_file import REFERENCES
from sagemp_cli.report.certificate import draw_certificate
from sagemp_cli.report.figure import draw_beside
from sagemp_cli.storage import Artifact, Certificate, Parent
from sagemp_cli.verification.attack.refutation import FalsifierOptions, attack, decided
from sagemp_cli.verification.verdict import answer_of


@dataclass(frozen=True)
class Options:
    """The section ``verify``.

    Attributes:
        references: sampled from the planner, if there is no file; None: one, of a file's planner all.
        seed: of what is sampled.
        samples: further plans of the planner, of which the certificate says how many certify too.
        file: references to verify instead.
        falsifier: how hard the verdicts are attacked.
        true_model: options of :class:`~sagemp_cli.pipeline.true_model.TrueModelProof`.
    """

    references: Count | None
    seed: Whole
    samples: Whole
    file: str | None
    falsifier: FalsifierOptions | None
    true_model: Mapping[str, Any] | None


SECTIONS = (
    Binding("verify", Options),
    TRUE_MODEL,
)


def run(context: StageContext) -> Path:
    """Sample or read references, prove what can be proved, try to refute the rest.

    Finished chunks of cells are kept until the certificate is written: an interrupted run goes on from there.
    """
    (problem, robot_files), section = trained_problem(context), SECTIONS[0].made(context.config)
    proof = Proof.of(context.config, problem)
    continuous = problem.dynamics.continuous
    folded = TrueModelProof.of(context.config, proof) if robot_files and not continuous else None
    if robot_files and continuous:
        context.progress.say(
            f"nothing is proved of {type(problem.dynamics.analytical).__name__} by way of the network: how they differ "
            "is bounded in discrete time only; in continuous time that robot can be proved as the ODE that it is"
        )
    planner_file, tracker_file = context.read("train-planner"), context.read("train-tracker")
    tracker = tracker_from(tracker_file)
    inputs: tuple[Artifact[Any] | Parent, ...] = (planner_file, tracker_file, *robot_files)
    planner = planner_from(planner_file)
    if section.file is None:
        every = len(planner.trajectories) if isinstance(planner, FromFile) else 1
        references = planner.sample(
            problem.start.center,
            problem.scene.goal,
            scene=problem.scene,
            count=section.references or every,
            generator=context.generator("verify: references"),
        )
    else:
        file = Path(section.file)
        references = read_references(file, horizon=problem.horizon, state_names=problem.dynamics.state_names)
        inputs = (*inputs, context.source(REFERENCES, file))
    beside = ("verify.falsifier", "verify.samples")  # no piece of the proof depends on them
    pieces = PartialResults.of(context, "verify", inputs, without=beside)
    verification = proof.verify(references, tracker, pieces=pieces, progress=context.progress)
    for note in verification.notes:
        context.progress.say(note)
    refutation = attack(
        verification,
        problem,
        tracker=tracker,
        generator=context.generator("verify: falsifier"),
        options=section.falsifier,
        progress=context.progress,
    )
    given = section.file is not None or isinstance(planner, FromFile)  # plans that nobody can draw more of
    for r, example in refutation.unproved:
        context.progress.say(
            f"reference {r}: a rollout breaks '{decided(example, problem.dynamics)}' by {example.depth:.3g} in "
            "float64, which rigorous arithmetic does not prove: it may be rounding, so nothing is refuted"
        )
    record = Certificate(
        tubes=tubes_record(refutation.verification),
        loop=loop_record(problem, tracker),
        counterexamples=tuple(
            counterexample_record(r, found, decided(found, problem.dynamics)) for r, found in refutation.counterexamples
        ),
        falsifier_rollouts=refutation.rollouts,
        verdict=str(answer_of(refutation.verification.verdicts)),
        true_model=folded.verify(references, tracker, context.progress) if folded and verification.safe else None,
        samples=None if given else sample_share(context, planner, tracker, proof, wanted=section.samples),
    )
    path = context.write("verify", record, inputs)
    pieces.remove()
    return path


def draw(context: StageContext) -> Path:
    """Draw the figure of what is there."""
    return draw_beside(context.output_path("verify"), draw_certificate, context.read("verify"))
