"""``sagemp verify``: references of the planner or of a file, their tubes, the verdict, and an attack on it."""

from __future__ import annotations

import os
from pathlib import Path

from sagemp_cli.errors import ConfigError
from sagemp_cli.models import planner_from, tracker_from
from sagemp_cli.planners.trajectory_file import REFERENCES
from sagemp_cli.reachability.falsifier import Counterexample as Found
from sagemp_cli.reachability.refutation import attack
from sagemp_cli.reachability.verdict import answer_of
from sagemp_cli.report.certificate import draw_certificate
from sagemp_cli.report.figure import draw_beside
from sagemp_cli.stages.options import options_for, whole_number
from sagemp_cli.stages.partial import PartialResults
from sagemp_cli.stages.problem import trained_problem
from sagemp_cli.stages.proof import Proof
from sagemp_cli.stages.reference_file import read_references
from sagemp_cli.stages.stage import StageContext
from sagemp_cli.stages.true_model import TrueModelProof
from sagemp_cli.stages.tubes import tubes_record
from sagemp_cli.storage import Certificate, Counterexample, Parent, sha256_of


def run(context: StageContext) -> Path:
    """Sample or read references, prove what can be proved, try to refute the rest.

    Finished chunks of cells are kept until the certificate is written: an interrupted run goes on from there.
    """
    (problem, robot_files), section = trained_problem(context), context.config["verify"]
    proof = Proof.of(context.config, problem)
    folded = TrueModelProof.of(section["true_model"], proof) if robot_files else None
    count = whole_number(section["references"], "verify.references")
    search = section.get("falsifier") or {}
    given = ("verification", "dynamics", "tracker", "scene", "generator", "progress")
    search = options_for(attack, search, "verify.falsifier", given=given)
    for key, value in search.items():
        whole_number(value, f"verify.falsifier.{key}", least=1 if key == "at_once" else 0)
    planner_file, tracker_file = context.read("train-planner"), context.read("train-tracker")
    tracker = tracker_from(tracker_file)
    files: tuple[Parent, ...] = ()
    if section["file"] is None:
        references = planner_from(planner_file).sample(
            problem.start.center,
            problem.scene.goal,
            scene=problem.scene,
            count=count,
            generator=context.generator("verify: references"),
        )
        if references.shape[1] != problem.horizon + 1:
            found = references.shape[1] - 1
            raise ConfigError(f"horizon is {problem.horizon}, but the planner's references have {found} steps")
    else:
        file = Path(section["file"])
        references = read_references(file, horizon=problem.horizon, state_names=problem.dynamics.state_names)
        files = (Parent(REFERENCES, os.path.relpath(file, context.folder), sha256_of(file)),)
    parents = (*(f.as_parent(f.path.stem, context.folder) for f in (planner_file, tracker_file, *robot_files)), *files)
    pieces = PartialResults.of(context, "verify", without=("verify.falsifier",), parents=parents)
    verification = proof.verify(references, tracker, pieces=pieces, progress=context.progress)
    refutation = attack(
        verification,
        problem.dynamics,
        tracker=tracker,
        scene=problem.scene,
        generator=context.generator("verify: falsifier"),
        progress=context.progress,
        **search,
    )
    record = Certificate(
        tubes=tubes_record(refutation.verification),
        tracker=tracker_file.record.weights,
        tracker_arguments=tracker_file.record.arguments,
        counterexamples=tuple(_counterexample(r, found) for r, found in refutation.counterexamples),
        falsifier_rollouts=refutation.rollouts,
        verdict=str(answer_of(refutation.verification.verdicts)),
        dynamics=robot_files[0].record.weights if robot_files else None,
        true_model=folded.verify(references, tracker, context.progress) if folded and verification.safe else None,
    )
    path = context.write("verify", record, (planner_file, tracker_file, *robot_files), files)
    pieces.remove()
    draw_beside(path, draw_certificate, context.read("verify"))
    return path


def _counterexample(reference: int, found: Found) -> Counterexample:
    """As stored; an obstacle is a 'collision' there."""
    return Counterexample(
        reference=reference,
        kind="collision" if found.kind == "obstacle" else found.kind,
        step=found.step,
        constraint=found.name,
        depth=found.depth,
        states=found.states.numpy(),
        disturbances=found.disturbances.numpy(),
    )
