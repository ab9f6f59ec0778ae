"""The experiment with a learned robot at toy size: its own model, planner and tracker of the other experiment."""

import shutil

import numpy as np
import pytest
import torch

from sagemp_cli.checker.check import check
from sagemp_cli.cli import verdict
from sagemp_cli.config.composition import compose
from sagemp_cli.errors import ArtifactError, ConfigError
from sagemp_cli.pipeline.context import StageContext
from sagemp_cli.pipeline.models import robot_from, tracker_from
from sagemp_cli.pipeline.problem import problem_of, robot_of, trained_problem
from sagemp_cli.pipeline.requirements import require_sound_config
from sagemp_cli.pipeline.stage import stage_named
from sagemp_cli.storage import DynamicsModel, read_artifact

EXPERIMENT = ("experiment=unicycle_node_learned", "effort=toy", "dynamics.hidden=[16,16]")


@pytest.fixture(scope="module")
def context(toy_root, tmp_path_factory):
    """After ``train-dynamics`` and ``verify``; treat its files as read-only."""
    root = tmp_path_factory.mktemp("learned")
    shutil.copytree(toy_root / "unicycle_node-toy", root / "unicycle_node-toy")
    context = StageContext.of(compose([*EXPERIMENT, f"artifacts={root}"]))
    stage_named("train-dynamics").run(context)
    stage_named("verify").run(context)
    return context


def test_the_model_is_stored_with_its_errors_and_a_figure(context):
    path = context.output_path("train-dynamics")
    record = read_artifact(path, DynamicsModel).record
    assert path.name == "dynamics.h5" and path.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert (record.error_rms < 0.3).all() and (record.error_max >= record.error_rms).all()
    assert record.error_counts.sum(axis=1).tolist() == [1000] * 4
    assert "validation theta error" in record.curve.names
    assert not context.partial_folder("train-dynamics").exists()


def test_what_simulates_and_proves_gets_the_weights_of_the_file(context):
    problem, files = trained_problem(context)
    assert [f.path.name for f in files] == ["dynamics.h5"]
    robot = robot_of(context.config)
    robot_from(files[0], robot)
    assert torch.equal(robot.layers[1].weight, problem.dynamics.layers[1].weight)
    assert torch.isnan(problem_of(context.config).dynamics.layers[1].weight).all()


def test_the_certificate_is_about_both_models_and_checks_from_the_file_alone(context):
    certificate = verdict.read_certificate(context.output_path("verify"))
    record = certificate.record
    assert record.verdict == "VERIFIED"
    assert {p.role for p in certificate.header.parents} == {"dynamics", "planner", "tracker"}
    assert record.true_model.tubes.verdict == ("SAFE",) and np.isfinite(record.true_model.deviation).all()
    report = check(certificate.path)
    assert report.answer == "VERIFIED" and report.true_model[0].proved


def test_no_rollout_of_either_model_leaves_its_tube(context):
    from sagemp_cli.loop.closed_loop import ClosedLoop

    record = verdict.read_certificate(context.output_path("verify")).record
    problem, _ = trained_problem(context)
    tracker = tracker_from(context.read("train-tracker"))
    generator = torch.Generator().manual_seed(0)
    x = problem.start.sample(500, generator)
    w = problem.disturbance.sample(500 * 25, generator).unflatten(0, (500, 25))
    for robot, tubes in ((problem.dynamics, record.tubes), (problem.dynamics.analytical, record.true_model.tubes)):
        states, _ = ClosedLoop(robot, tracker, torch.from_numpy(tubes.references[0])).rollout(x, w)
        states = states.detach().numpy()[:, None]
        inside = (states >= tubes.tube_lower) & (states <= tubes.tube_upper)
        assert inside.all((2, 3)).any(1).all()


def test_the_verdict_says_in_words_what_is_proved_of_which_model(context):
    certificate = verdict.read_certificate(context.output_path("verify"))
    lines = "\n".join(verdict.as_lines(certificate))
    assert "robot: a network learned from Unicycle; the verdict is about the network" in lines
    assert "Unicycle itself: SAFE (4 cells)" in lines
    assert "proved deviation of the network, folded into w: at most" in lines
    data = verdict.as_json(certificate)["learned"]
    assert data["true_model"]["certified"] == 1
    assert [d["state"] for d in data["true_model"]["deviation"]] == ["px", "py", "theta", "v"]


def test_without_the_model_the_command_that_makes_it_is_named(context, tmp_path):
    config = compose([*EXPERIMENT, f"artifacts={tmp_path}"])
    with pytest.raises(ArtifactError, match="dynamics.h5: missing; make it with 'sagemp train-dynamics experiment="):
        stage_named("verify").run(StageContext.of(config))


def test_a_robot_of_formulas_has_nothing_to_learn(tmp_path):
    with pytest.raises(ConfigError, match="dynamics: Unicycle has nothing to learn; choose a learned robot"):
        stage_named("train-dynamics").run(StageContext.of(compose(["effort=toy", f"artifacts={tmp_path}"])))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("+dynamics_training.stepz=3", "dynamics_training.stepz: no such option"),
        ("+dynamics_training.enclosure.wait=3", "dynamics_training.enclosure.wait: EnclosureWeight has no such option"),
        ("+verify.true_modell=3", "verify.true_modell: no such option"),
        ("dynamics.inputs=[thta]", "dynamics.inputs: there is no state 'thta'"),
    ],
)
def test_a_wrong_option_is_found_before_any_work(override, message):
    with pytest.raises(ConfigError, match=message):
        require_sound_config(compose([*EXPERIMENT, override]))


def test_the_analytical_model_may_have_a_partition_of_its_own(context, tmp_path):
    with pytest.raises(ConfigError, match="verify.true_model.partitions must be a positive number"):
        config = compose([*EXPERIMENT, f"artifacts={context.config['artifacts']}", "verify.true_model.partitions=0"])
        stage_named("verify").run(StageContext.of(config, overwrite=True))
