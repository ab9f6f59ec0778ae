import numpy as np
import pytest
import torch

from sagemp_cli.config.composition import compose
from sagemp_cli.errors import ArtifactError, ConfigError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.pipeline.context import StageContext
from sagemp_cli.pipeline.models import planner_from, tracker_from
from sagemp_cli.pipeline.problem import problem_of
from sagemp_cli.pipeline.stage import STAGES, stage_named
from sagemp_cli.storage import read_artifact

from .conftest import assert_same


def read(folder, stage):
    found = stage_named(stage)
    return read_artifact(folder / found.output, found.record)


def test_every_stage_writes_its_artifact_a_figure_and_its_lineage(toy_folder):
    config = compose(["effort=toy"])
    stages = [stage for stage in STAGES if stage.applies(config)]
    for stage in stages:
        artifact = read(toy_folder, stage.name)
        assert artifact.header.stage == stage.name
        assert {p.role for p in artifact.header.parents} == {stage_named(s).role for s in stage.inputs_in(config)}
        for parent in artifact.header.parents:
            assert parent.sha256 == read(toy_folder, next(s.name for s in STAGES if s.role == parent.role)).sha256
        assert (toy_folder / stage.output).with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    expected = {s.output for s in stages} | {s.output.replace(".h5", ".png") for s in stages}
    assert {p.name for p in toy_folder.iterdir()} == expected  # no partial folder, no temporary file


def test_demonstrations_are_rollouts_of_their_controls(toy_folder):
    artifact = read(toy_folder, "gen-data")
    dynamics, record = problem_of(artifact.header.config).dynamics, artifact.record
    x = torch.from_numpy(record.states[:, 0])
    for k in range(record.controls.shape[1]):
        x = dynamics.step(x, torch.from_numpy(record.controls[:, k]), torch.zeros_like(x))
        np.testing.assert_allclose(x.numpy(), record.states[:, k + 1], atol=1e-9)
    assert len(record.states) + len(record.failed) == 12
    assert set("".join(record.side)) <= {"L", "R"}


def test_the_toy_experiment_is_certified_and_no_random_rollout_leaves_its_tube(toy_folder):
    certificate = read(toy_folder, "verify").record
    assert certificate.verdict == "VERIFIED"
    tubes = certificate.tubes
    assert tubes.verdict == ("SAFE",)
    assert tubes.cell_lower.shape[0] == 4
    assert (tubes.clearance > 0).all() and (tubes.goal_margin >= 0).all()
    tracker_file = read(toy_folder, "train-tracker")
    problem, tracker = problem_of(tracker_file.header.config), tracker_from(tracker_file)
    loop = ClosedLoop(problem.dynamics, tracker, torch.from_numpy(tubes.references[0]))
    generator = torch.Generator().manual_seed(0)
    for c in range(4):
        low, high = torch.from_numpy(tubes.cell_lower[c]), torch.from_numpy(tubes.cell_upper[c])
        x = low + (high - low) * torch.randint(2, (500, 4), generator=generator)
        corners = torch.randint(2, (500, 25, 4), generator=generator)
        w = torch.from_numpy(np.where(corners, tubes.disturbance_upper, tubes.disturbance_lower))
        states, controls = (v.detach().numpy() for v in loop.rollout(x, w))
        assert (states >= tubes.tube_lower[c]).all() and (states <= tubes.tube_upper[c]).all()
        assert (controls >= tubes.control_lower[0]).all() and (controls <= tubes.control_upper[0]).all()


def test_the_reference_of_verify_starts_in_the_middle_of_the_start_box(toy_folder):
    tubes = read(toy_folder, "verify").record.tubes
    np.testing.assert_allclose(tubes.references[0, 0], 0.5 * (tubes.start_lower[0] + tubes.start_upper[0]), atol=1e-12)


def test_the_library_accounts_for_every_sample_and_execution_stays_in_its_tubes(toy_folder):
    library, rollouts = read(toy_folder, "build-library").record, read(toy_folder, "execute").record
    count = len(library.tubes.references)
    assert count == library.wanted == 2
    assert library.reason_counts.sum() == len(library.rejected_reason) <= library.sampled - count
    assert set(library.tubes.verdict) == {"SAFE"}
    assert len(rollouts.states) == 4 * 10
    assert rollouts.in_tube.all() and rollouts.safe.all()
    assert rollouts.chosen.max() < count


def test_a_trained_planner_and_tracker_come_back_from_their_files(toy_folder):
    planner = planner_from(read(toy_folder, "train-planner"))
    problem = problem_of(read(toy_folder, "verify").header.config)
    draws = [
        planner.sample(
            problem.start.center,
            problem.scene.goal,
            scene=problem.scene,
            count=3,
            generator=torch.Generator().manual_seed(5),
        )
        for _ in range(2)
    ]
    assert draws[0].shape == (3, 26, 4) and torch.equal(*draws)


def test_the_same_config_gives_the_same_certificate(toy_folder, work):
    context = work("gen-data", "train-planner", "train-tracker")
    again = read_artifact(stage_named("verify").run(context), stage_named("verify").record).record
    first = read(toy_folder, "verify").record
    assert_same(again, first)


def test_a_missing_input_is_named_with_the_command_that_makes_it(work):
    with pytest.raises(ArtifactError, match=r"planner.h5: missing; make it with 'sagemp train-planner experiment="):
        stage_named("verify").run(work("gen-data"))


def test_an_output_that_exists_is_refused_before_any_work(work):
    context = work("verify")
    with pytest.raises(ArtifactError, match="certificate.h5: exists already; pass --overwrite to replace it"):
        stage_named("verify").run(context)


def test_an_input_of_another_config_is_refused(work):
    context = work("gen-data", "train-planner", "train-tracker", overrides=("dynamics.dt=0.05",))
    with pytest.raises(ArtifactError, match="planner.h5: was made with dynamics.dt=0.1, this config says 0.05"):
        stage_named("verify").run(context)


@pytest.mark.parametrize(
    ("stage", "override", "message"),
    [
        ("gen-data", "expert.count=0", "expert.count must be a whole number of at least 1, found 0"),
        ("gen-data", "+expert.margn=1", r"expert.margn: Expert has no such option \(did you mean 'margin'\?\)"),
        (
            "gen-data",
            "+expert.weights.efort=[1]",
            r"expert.weights.efort: Weights has no such option \(did you mean 'effort'",
        ),
        (
            "train-planner",
            "+planner_training.stepz=1",
            r"planner_training.stepz: no such option \(did you mean 'steps'",
        ),
        (
            "train-planner",
            "+planner_training.loss.pul=1",
            r"planner_training.loss.pul: NeuralODELoss has no such",
        ),
        ("train-planner", "planner_training.held_out=1.5", "planner_training.held_out must be a number in"),
        (
            "train-tracker",
            "tracker_training.references=0",
            "tracker_training.references must be a whole",
        ),
        ("train-tracker", "+tracker_training.lr=1", "tracker_training.lr: no such option"),
        ("verify", "proof.partitions=0", "partitions must be a positive number of cells in all"),
        ("verify", "verify.references=0", "verify.references must be a whole number"),
        ("verify", "+verify.falsifier.steps=3", r"verify.falsifier.steps: no such option"),
        ("build-library", "library.budget=1", "library.budget must be at least library.size, 2; found 1"),
        ("build-library", "library.start_spread=2.0", "library.start_spread must be a share of X_I"),
        ("execute", "execute.rollouts=0", "execute.rollouts must be a whole number of at least 1, found 0"),
    ],
)
def test_a_wrong_option_is_one_line_and_nothing_is_written(work, stage, override, message):
    context = work(overrides=(override,))
    with pytest.raises(ConfigError, match=message) as caught:
        stage_named(stage).run(context)
    assert "\n" not in str(caught.value)
    assert list(context.folder.iterdir()) == []


def test_executions_start_all_over_the_start_box(toy_folder):
    artifact = read(toy_folder, "execute")
    problem, found = problem_of(artifact.header.config), artifact.record
    starts = np.stack([found.states[found.query == q][:, 0] for q in range(found.query.max() + 1)])
    assert (starts == starts[:, :1]).all(), "all rollouts of a query start where it was measured"
    assert len(np.unique(starts[:, 0], axis=0)) == len(starts)
    uncertain = problem.start.radius.numpy() > 0
    away = np.abs(starts[:, 0] - problem.start.center.numpy())[:, uncertain] / problem.start.radius.numpy()[uncertain]
    assert (away <= 1).all() and (away.max(0) > 0.4).all(), "not only near its middle"


@pytest.mark.parametrize("spread", [0.0, 0.25, 1.0])
def test_references_of_a_library_start_in_the_share_of_the_start_box_that_the_config_says(work, monkeypatch, spread):
    import sagemp_cli.stages.build_library as stage

    context = work("train-planner", "train-tracker", overrides=(f"library.start_spread={spread}",))
    drawn = []

    def build(draw, *_, **__):
        drawn.append(draw(64))
        raise KeyboardInterrupt

    monkeypatch.setattr(stage, "build_library", build)
    with pytest.raises(KeyboardInterrupt):
        stage.run(context)
    start = problem_of(context.config).start
    away = (drawn[0][:, 0] - start.center).abs()
    assert bool((away <= spread * start.radius + 1e-12).all())
    uncertain = start.radius > 0
    assert bool((away.amax(0)[uncertain] >= 0.9 * spread * start.radius[uncertain]).all())


def test_a_certificate_says_how_many_further_plans_certify(toy_folder):
    artifact = read(toy_folder, "verify")
    found, config = artifact.record.samples, artifact.header.config
    assert (found.drawn, found.seed) == (config["verify"]["samples"], 0) == (2, 0)
    assert 0 <= found.certified <= found.drawn


def test_the_share_of_further_plans_counts_what_affine_certifies_from_all_of_the_start_box(work, monkeypatch):
    from sagemp_cli.pipeline import sample_share as module
    from sagemp_cli.pipeline.proof import Proof

    context = work("train-planner", "train-tracker", overrides=("verify.seed=3",))
    seen = []
    prove = Proof.verify

    def watched(proof, references, tracker, **options):
        found = prove(proof, references, tracker, **options)
        seen.append((proof.propagator.name, references, found.start, found.safe))
        return found

    monkeypatch.setattr(Proof, "verify", watched)
    problem = problem_of(context.config)
    planner, tracker = planner_from(context.read("train-planner")), tracker_from(context.read("train-tracker"))
    found = module.sample_share(context, planner, tracker, Proof.of(context.config, problem), wanted=5)
    ((propagator, references, start, safe),) = seen
    assert propagator == "affine" and (found.drawn, found.certified, found.seed) == (5, len(safe), 3)
    assert len(torch.unique(references[:, 0], dim=0)) == 5, "each from a start of its own"
    assert torch.equal(start.lower, problem.start.lower.expand(5, -1)), "each proved from all of X_I"
    assert module.sample_share(context, planner, tracker, Proof.of(context.config, problem), wanted=0) is None


def test_of_a_planner_that_is_a_file_every_trajectory_is_verified_and_no_further_ones_drawn(work, tmp_path):
    plan = read(work("verify").folder, "verify").record.tubes.references[0]
    np.savez(tmp_path / "plans.npz", references=np.stack([plan, plan + 0.001, plan - 0.001]))
    overrides = (
        "name=mine",
        "planner=from_file",
        f"planner.path={tmp_path / 'plans.npz'}",
        "sources.train-tracker=unicycle_node",
    )
    work("gen-data", "train-planner", "train-tracker")
    context = StageContext.of(compose(["effort=toy", f"artifacts={tmp_path}", *overrides]))
    for name in ("train-planner", "verify"):
        stage_named(name).run(context)
    found = read(context.folder, "verify").record
    assert len(found.tubes.verdict) == 3 and found.samples is None
    single = StageContext.of(
        compose(["effort=toy", f"artifacts={tmp_path}", *overrides, "verify.references=1"]), overwrite=True
    )
    stage_named("verify").run(single)
    assert len(read(context.folder, "verify").record.tubes.verdict) == 1
