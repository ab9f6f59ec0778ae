"""The stage safety-rates on the toy experiment: what is certified is safe, and an interrupted proof goes on."""

import dataclasses

import numpy as np
import pytest
import torch

from sagemp_cli.dynamics.inverse import invert
from sagemp_cli.errors import ConfigError, UsageError
from sagemp_cli.pipeline.partial import PartialResults
from sagemp_cli.pipeline.problem import problem_of, trained_problem
from sagemp_cli.pipeline.proof import Proof
from sagemp_cli.pipeline.stage import stage_named, stages_of
from sagemp_cli.stages import safety_rates
from sagemp_cli.storage import SafetyRates, read_artifact
from sagemp_cli.verification.attack.refutation import SoundnessError
from sagemp_cli.verification.verdict import Outcome

from .conftest import Interrupt, assert_same

STAGE = stage_named("safety-rates")
INPUTS = ("gen-data", "train-planner", "train-tracker")
# One cell at a time and in this process: the proof of three references has twelve pieces to go on from.
PIECES = ("proof.memory=0.005", "executor=serial", "safety.references=3")


@pytest.fixture
def artifact(toy_folder):
    return read_artifact(toy_folder / "safety.h5", SafetyRates)


def test_what_is_certified_is_safe_and_reaches_the_goal_in_every_closed_loop_rollout(artifact):
    record = artifact.record
    assert record.references.shape == (6, 26, 4)
    assert record.closed_loop.clearance.shape == (6, 3, 5)
    certified = np.array(record.verdict) == "SAFE"
    assert certified.any()
    assert (record.closed_loop.clearance[certified] > 0).all()
    assert record.closed_loop.reached[certified].all()
    assert (record.step[certified] == -1).all()


def test_rollouts_lie_in_the_tube_of_their_reference_and_start_in_x_i(artifact):
    record, problem = artifact.record, problem_of(artifact.header.config)
    start = np.stack([problem.start.lower.numpy(), problem.start.upper.numpy()])
    for states in (record.open_loop.nearest, record.closed_loop.nearest):
        assert (start[0] <= states[:, :, 0]).all() and (states[:, :, 0] <= start[1]).all()
    states = record.closed_loop.nearest
    assert (record.tube_lower[:, None] <= states + 1e-9).all() and (states - 1e-9 <= record.tube_upper[:, None]).all()


def test_the_stored_controls_are_those_of_the_inverse(artifact):
    record, dynamics = artifact.record, problem_of(artifact.header.config).dynamics
    found = invert(dynamics, torch.from_numpy(record.references))
    np.testing.assert_array_equal(record.controls, found.controls.numpy())
    np.testing.assert_allclose(record.residual, np.sqrt((found.residual.numpy() ** 2).mean(1)))
    assert (dynamics.control_lower.numpy() <= record.controls).all()
    # A unicycle turns and accelerates as it is told: nothing is left of these two but what the limits cut off.
    assert (record.residual[:, 2:] < 0.5).all() and (record.residual[:, :2] > 0).all()


def test_references_start_where_those_of_a_library_do(artifact):
    problem, spread = problem_of(artifact.header.config), artifact.header.config["library"]["start_spread"]
    away = np.abs(artifact.record.references[:, 0] - problem.start.center.numpy())
    assert (away <= spread * problem.start.radius.numpy() + 1e-9).all()


def test_run_makes_it_only_when_asked(artifact):
    assert STAGE not in stages_of(artifact.header.config)
    assert [s.name for s in stages_of(artifact.header.config, ("safety-rates",))] == [*INPUTS, "safety-rates"]


def test_the_proof_goes_on_where_it_was_interrupted_and_ends_in_the_same_bits(work):
    whole = read_artifact(STAGE.run(work(*INPUTS, overrides=PIECES)), SafetyRates).record
    first = 3 + 1  # the references are rolled out before the proof begins
    context = work(*INPUTS, overrides=PIECES, overwrite=True, progress=Interrupt(after=first))
    with pytest.raises(KeyboardInterrupt):
        STAGE.run(context)
    assert len(list(context.partial_folder("safety-rates").rglob("*.npz"))) == 1
    context = work(*INPUTS, overrides=PIECES, overwrite=True, progress=Interrupt())
    again = read_artifact(STAGE.run(context), SafetyRates).record
    assert 0 < context.progress.resumed["propagating cells"] < 12
    assert_same(again, whole)
    assert not context.partial_folder("safety-rates").exists()


def test_finished_pieces_serve_other_rollouts_but_not_other_references(work):
    def pieces(*overrides):
        context = work(overrides=overrides)
        without = ("safety.rollouts", "safety.within_limits")
        return PartialResults.of(context, "safety-rates", without=without).folder

    assert pieces("safety.rollouts=7", "safety.within_limits=false") == pieces()
    assert pieces("safety.references=5") != pieces()
    assert pieces("library.start_spread=0.1") != pieces()


def test_a_proof_that_rollouts_contradict_is_loud_and_nothing_is_written(work, monkeypatch):
    """A proof that calls everything safe, of a goal that no rollout reaches."""
    right = Proof.verify

    def wrong(self, references, tracker, **options):
        found = right(self, references, tracker, **options)
        safe = tuple(dataclasses.replace(v, outcome=Outcome.SAFE) for v in found.verdicts)
        return dataclasses.replace(found, verdicts=safe)

    def elsewhere(context):
        problem, files = trained_problem(context)
        goal = dataclasses.replace(problem.scene.goal, lower=problem.scene.goal.upper)
        return dataclasses.replace(problem, scene=dataclasses.replace(problem.scene, goal=goal)), files

    monkeypatch.setattr(Proof, "verify", wrong)
    monkeypatch.setattr(safety_rates, "trained_problem", elsewhere)
    context = work(*INPUTS)
    with pytest.raises(SoundnessError, match=r"reference 0 is certified, but 15 of its 15 .* and misses the goal"):
        STAGE.run(context)
    assert not context.output_path("safety-rates").exists()


def test_a_robot_without_an_inverse_is_one_line(work, monkeypatch):
    problem = problem_of(work().config)
    real = type(problem.dynamics).derivative
    monkeypatch.setattr(type(problem.dynamics), "derivative", lambda self, x, u: real(self, x, u**3))
    context = work(*INPUTS)
    with pytest.raises(UsageError, match="Unicycle has no inverse: its derivative is not affine in the control"):
        STAGE.run(context)
    assert not context.output_path("safety-rates").exists()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("safety.references=0", "safety.references must be a whole number of at least 1, found 0"),
        ("safety.rollouts=0", "safety.rollouts must be a whole number of at least 1, found 0"),
        ("safety.within_limits=3", "safety.within_limits must be true or false, found 3"),
        ("library.start_spread=2.0", "library.start_spread must be a share of X_I"),
        ("proof.partitions=0", "partitions must be a positive number of cells in all"),
    ],
)
def test_a_wrong_option_is_one_line_and_nothing_is_written(work, override, message):
    context = work(overrides=(override,))
    with pytest.raises(ConfigError, match=message) as caught:
        STAGE.run(context)
    assert "\n" not in str(caught.value)
    assert list(context.folder.iterdir()) == []
