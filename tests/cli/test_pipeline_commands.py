"""The stage commands, run and status: order, exit codes, and nothing replaced unasked."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import pytest

from sagemp_cli.config.composition import compose
from sagemp_cli.pipeline.stage import STAGES, stages_of
from sagemp_cli.storage import Rollouts, Samples, TrackerModel, read_artifact

NAMES = [stage.name for stage in stages_of(compose([]))]
FOLDER = Path("artifacts/unicycle_node")


def states(sagemp, *overrides):
    files = json.loads(sagemp("status", "--json", *overrides).stdout)["files"]
    return {f["stage"]: f["state"] for f in files}


def test_run_makes_everything_in_order_and_ends_with_verdict_certificate_and_figure(sagemp, made_up):
    result = sagemp("run")
    assert result.exit_code == 0, result.stderr
    assert made_up.ran == NAMES
    lines = result.stdout.splitlines()
    begin = lines.index("VERIFIED: 1 of 1 references certified, 4 cells (experiment unicycle_node, K = 5, a text)")
    assert lines[begin + 1] == "  reference 0: SAFE over the whole of every step, keeps 0.25 m from lower disc"
    # The made-up controls go beyond the robot's limits, and whoever reads the verdict is told.
    assert lines[begin + 2].startswith("  controls: turn_rate asks for ")
    assert lines[begin + 2].endswith(" rad/s, beyond its limits -1.5 to 1.5; the proof holds for actuators that follow")
    assert lines[-2:] == [f"certificate {FOLDER}/certificate.h5", f"figure      {FOLDER}/certificate.png"]


def test_run_again_makes_nothing(sagemp, made_up):
    sagemp("run")
    made_up.ran.clear()
    result = sagemp("run")
    assert result.exit_code == 0
    assert made_up.ran == []
    assert "gen-data: up to date" in result.stdout


def test_run_remakes_what_a_changed_key_makes_stale_and_what_follows_from_it(sagemp, made_up):
    sagemp("run")
    made_up.ran.clear()
    result = sagemp("run", "tracker.lookahead=7")
    assert made_up.ran == ["train-tracker", "verify", "build-library", "execute"]
    assert "train-tracker: making it (stale: was made with tracker.lookahead=5, this config says 7)" in result.stdout
    assert "verify: making it (stale: its input tracker.h5 has changed since)" in result.stdout


def test_run_until_a_stage_stops_there(sagemp, made_up):
    result = sagemp("run", "--until", "train-tracker")
    assert result.exit_code == 0
    assert made_up.ran == NAMES[:3]
    assert "VERIFIED" not in result.stdout


def test_run_dry_says_what_it_would_make_and_makes_nothing(sagemp, made_up):
    result = sagemp("run", "--dry-run")
    assert result.exit_code == 0
    assert [line.split(":")[0] for line in result.stdout.splitlines()] == NAMES
    assert made_up.ran == []
    assert not FOLDER.exists()


def test_run_until_an_unknown_stage_names_the_nearest(sagemp):
    result = sagemp("run", "--until", "verfy")
    assert result.exit_code == 2
    assert "--until verfy: no such stage (did you mean 'verify'?); known: gen-data, " in result.stderr


def test_verify_after_run_answers_from_the_fresh_certificate(sagemp, made_up):
    sagemp("run", "experiment=unicycle_node")
    made_up.ran.clear()
    result = sagemp("verify", "experiment=unicycle_node", "--partitions", "4")
    assert result.exit_code == 0
    assert made_up.ran == []
    assert result.stdout.startswith("up to date, from the file of ")
    assert "VERIFIED: 1 of 1 references certified" in result.stdout


def test_verify_with_other_partitions_does_not_replace_the_certificate(sagemp, made_up):
    sagemp("run")
    before = (FOLDER / "certificate.h5").read_bytes()
    result = sagemp("verify", "--partitions", "3x3")
    assert result.exit_code == 2
    assert (
        f"error: {FOLDER}/certificate.h5: exists already and is stale (was made with proof.partitions=4, this config "
        "says 3x3); pass --overwrite to remake it"
    ) in result.stderr
    assert (FOLDER / "certificate.h5").read_bytes() == before
    assert sagemp("verify", "--partitions", "3x3", "--overwrite").exit_code == 0
    assert (FOLDER / "certificate.h5").read_bytes() != before


@pytest.mark.parametrize(("verdict", "code"), [("VERIFIED", 0), ("FALSIFIED", 10), ("UNKNOWN", 5)])
def test_the_verdict_is_the_exit_code(sagemp, made_up, verdict, code):
    made_up.certificate["verdict"] = verdict
    sagemp("run", "--until", "train-tracker")
    result = sagemp("verify")
    assert result.exit_code == code
    assert result.stdout.startswith(verdict)
    assert sagemp("verify").exit_code == code
    assert sagemp("run", "--until", "verify").exit_code == code


def test_verify_names_the_step_and_the_obstacle_that_decided(sagemp, made_up):
    made_up.certificate["verdict"] = "UNKNOWN"
    sagemp("run", "--until", "train-tracker")
    assert "  reference 0: MAY_COLLIDE at step 17.25, 4.312 s (lower disc)" in sagemp("verify").stdout


def test_verify_speaks_json(sagemp, made_up):
    sagemp("run", "--until", "train-tracker")
    found = json.loads(sagemp("verify", "--json").stdout)
    assert (found["verdict"], found["exit_code"], found["from_file"]) == ("VERIFIED", 0, False)
    assert found["references"] == [
        {
            "verdict": "SAFE", "step": None, "fraction": None, "time": None, "constraint": "", "clearance": 0.25,
            "nearest": "lower disc",
        }
    ]  # fmt: skip
    assert (found["between"], found["holds"]) == ("segments", "over the whole of every step")
    assert found["figure"] == f"{FOLDER}/certificate.png"
    assert json.loads(sagemp("verify", "--json").stdout)["from_file"] is True


@pytest.mark.parametrize("name", [n for n in NAMES if n != "verify"])
def test_a_stage_refuses_to_replace_its_output_even_a_fresh_one(sagemp, made_up, name):
    sagemp("run")
    path = FOLDER / next(s.output for s in STAGES if s.name == name)
    before = path.read_bytes()
    result = sagemp(name)
    assert result.exit_code == 2
    assert (
        result.stderr == f"error: {path}: exists already and is up to date; pass --overwrite to remake it "
        "('sagemp run' skips what is up to date)\n"
    )
    assert path.read_bytes() == before
    assert sagemp(name, "--overwrite").exit_code == 0
    assert path.read_bytes() != before


@pytest.mark.parametrize(
    ("name", "missing", "maker"),
    [
        ("train-planner", "demonstrations.h5", "gen-data"),
        ("train-tracker", "planner.h5", "train-planner"),
        ("verify", "planner.h5", "train-planner"),
        ("build-library", "planner.h5", "train-planner"),
        ("execute", "planner.h5", "train-planner"),
    ],
)
def test_a_missing_input_names_the_command_that_makes_it(sagemp, name, missing, maker):
    result = sagemp(name, "tracker.lookahead=7")
    assert result.exit_code == 2
    assert (
        result.stderr == f"error: {FOLDER}/{missing}: missing; make it with 'sagemp {maker} tracker.lookahead=7' "
        "(or 'sagemp run tracker.lookahead=7', which makes everything that is missing)\n"
    )
    assert not FOLDER.exists()


def test_a_dry_run_says_what_would_be_read_and_written(sagemp, made_up):
    sagemp("run", "--until", "train-tracker")
    made_up.ran.clear()
    result = sagemp("verify", "--dry-run")
    assert result.exit_code == 0
    assert result.stdout.splitlines() == [
        "sagemp verify would",
        f"  read     {FOLDER}/planner.h5 (fresh)",
        f"  read     {FOLDER}/tracker.h5 (fresh)",
        f"  write    {FOLDER}/certificate.h5",
    ]
    assert made_up.ran == []
    sagemp("verify")
    replacing = sagemp("verify", "--overwrite", "--dry-run").stdout.splitlines()
    assert replacing[-1] == f"  replace  {FOLDER}/certificate.h5"


def test_status_names_the_command_that_makes_a_missing_file_as_it_has_to_be_typed(sagemp):
    files = json.loads(sagemp("status", "--json", "effort=toy", "--seed", "3").stdout)["files"]
    assert [f["why"] for f in files] == [f"make it with 'sagemp {name} effort=toy seed=3'" for name in NAMES]
    files = json.loads(sagemp("status", "--json", "experiment=planar_cfm").stdout)["files"]
    found = {f["stage"]: f["why"] for f in files}
    assert found["train-planner"] == "make it with 'sagemp train-planner experiment=planar_cfm'"
    assert found["train-tracker"] == "make it with 'sagemp train-tracker experiment=planar_node'"


def test_an_input_of_another_config_is_refused_and_the_key_named(sagemp, made_up):
    sagemp("run", "--until", "train-tracker")
    for override, key in (
        ("dynamics.dt=0.05", "dynamics.dt=0.1, this config says 0.05"),
        ("horizon=50", "horizon=100, this config says 50"),
        ("planner.frequencies=5", "planner.frequencies=3, this config says 5"),
    ):
        result = sagemp("verify", override)
        assert result.exit_code == 2
        assert f"planner.h5: was made with {key}; remake it with" in result.stderr
        assert not (FOLDER / "certificate.h5").exists()


def test_an_input_of_another_experiment_is_refused(sagemp, made_up):
    sagemp("run", "--until", "train-tracker")
    FOLDER.rename("artifacts/other")
    result = sagemp("verify", "name=other")
    assert result.exit_code == 2
    assert "artifacts/other/planner.h5: was made with name=unicycle_node, this config says other" in result.stderr


def test_an_input_whose_parent_has_changed_is_refused(sagemp, made_up):
    sagemp("run", "--until", "train-tracker")
    sagemp("gen-data", "--overwrite")
    result = sagemp("verify")
    assert result.exit_code == 2
    assert f"planner.h5: was made from an earlier {FOLDER}/demonstrations.h5, which has changed since" in result.stderr
    assert not (FOLDER / "certificate.h5").exists()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: b"no HDF5 at all", "not a readable HDF5 file"),
        (lambda data: data[: len(data) // 2], "truncated file"),
        (lambda data: b"", "not a readable HDF5 file"),
    ],
)
def test_a_damaged_input_is_refused_and_left_alone(sagemp, made_up, damage, message):
    sagemp("run", "--until", "train-tracker")
    path = FOLDER / "tracker.h5"
    path.write_bytes(damage(path.read_bytes()))
    before = path.read_bytes()
    for command in (["verify"], ["run"], ["inspect", path]):
        result = sagemp(*command)
        assert result.exit_code == 2, command
        assert f"error: {path}: " in result.stderr
        assert message in result.stderr
        assert len(result.stderr.splitlines()) == 1
    assert path.read_bytes() == before
    assert states(sagemp)["train-tracker"] == "damaged"


def test_a_foreign_hdf5_file_in_the_place_of_an_input_is_refused(sagemp, made_up):
    sagemp("run", "--until", "train-tracker")
    (FOLDER / "tracker.h5").unlink()
    with h5py.File(FOLDER / "tracker.h5", "w") as file:
        file["x"] = 1.0
    result = sagemp("verify")
    assert result.exit_code == 2
    assert f"{FOLDER}/tracker.h5: not an artifact of sagemp (schema 'none'; known: " in result.stderr


def test_status_tells_fresh_stale_and_missing_files_apart_and_says_why(sagemp, made_up):
    assert set(states(sagemp).values()) == {"missing"}
    sagemp("run", "--until", "verify")
    assert states(sagemp) == dict.fromkeys(NAMES[:4], "fresh") | dict.fromkeys(NAMES[4:], "missing")
    assert states(sagemp, "tracker.lookahead=7") == {
        "gen-data": "fresh",
        "train-planner": "fresh",
        "train-tracker": "stale",
        "verify": "stale",
        "build-library": "missing",
        "execute": "missing",
    }
    shown = sagemp("status", "tracker.lookahead=7").stdout
    assert "was made with tracker.lookahead=5, this config says 7" in shown
    assert "its input tracker.h5 is stale" in shown


def test_another_effort_has_a_folder_of_its_own(sagemp, made_up):
    sagemp("gen-data", "effort=demo")
    assert Path("artifacts/unicycle_node-demo/demonstrations.h5").exists()
    assert not FOLDER.exists()


def test_the_seed_option_is_the_seed_of_the_config(sagemp, made_up):
    sagemp("gen-data", "--seed", "5")
    assert states(sagemp)["gen-data"] == "stale"
    assert states(sagemp, "seed=5")["gen-data"] == "fresh"


def test_inspect_shows_kind_provenance_fields_and_verdicts(sagemp, made_up):
    sagemp("run", "--until", "verify")
    shown = sagemp("inspect", FOLDER / "certificate.h5").stdout
    for text in ("certificate", "verify", "planner.h5 (unchanged)", "reference 0: SAFE", "cells K+1 n", "tube_lower"):
        assert text in shown
    found = json.loads(sagemp("inspect", "--json", FOLDER / "certificate.h5").stdout)
    fields = {f["name"]: f for f in found["fields"]}
    assert fields["tubes/references"]["holds"] == "float64 (1, 6, 4)"
    assert fields["tubes/seconds"]["units"] == "s"
    assert fields["loop/lookahead"]["holds"] == "7" and found["claim"]["claims"][0][0] == "cannot be checked"
    assert found["verdicts"][0] == "VERIFIED"
    sagemp("train-planner", "--overwrite")
    assert "planner.h5 (changed since)" in sagemp("inspect", FOLDER / "certificate.h5").stdout


def test_inspect_says_whether_the_content_is_what_was_written(sagemp, made_up):
    sagemp("run", "--until", "verify")
    path = FOLDER / "certificate.h5"
    assert "as it was written" in sagemp("inspect", path).stdout
    with h5py.File(path, "a") as file:
        file["data/tubes/clearance"][...] = 9.0
    assert "CHANGED since it was written" in sagemp("inspect", path).stdout


def test_after_a_refuted_claim_no_library_is_built_and_the_code_is_that_of_the_verdict(sagemp, made_up):
    made_up.certificate["verdict"] = "FALSIFIED"
    result = sagemp("run")
    assert result.exit_code == 10
    assert made_up.ran == NAMES[: NAMES.index("verify") + 1]
    assert "build-library, execute: not made, the claim is refuted" in result.stdout
    assert "FALSIFIED: " in result.stdout
    assert sagemp("run").exit_code == 10
    assert made_up.ran == NAMES[: NAMES.index("verify") + 1]


def test_the_verdict_is_shown_even_if_no_library_can_be_built(sagemp, made_up, monkeypatch):
    import sagemp_cli.stages.build_library as stage
    from sagemp_cli.library.builder import NothingCertifiedError

    def nothing(context):
        raise NothingCertifiedError("library: none of 60 sampled references could be certified")

    monkeypatch.setattr(stage, "run", nothing)
    made_up.certificate["verdict"] = "UNKNOWN"
    result = sagemp("run")
    assert result.exit_code == 5
    assert "UNKNOWN: 0 of 1 references certified" in result.stdout
    assert result.stderr.startswith("error: library: none of 60")


@pytest.mark.parametrize("name", [n for n in NAMES if n != "verify"])
def test_a_dry_run_of_a_stage_that_is_up_to_date_is_no_error(sagemp, made_up, name):
    sagemp("run")
    made_up.ran.clear()
    result = sagemp(name, "--dry-run")
    assert result.exit_code == 0
    path = FOLDER / next(s.output for s in STAGES if s.name == name)
    assert result.stdout == f"sagemp {name} would do nothing: {path} is up to date; --overwrite remakes it\n"
    assert made_up.ran == []


def test_a_hint_acts_on_the_same_experiment_and_config_as_the_call(sagemp, made_up):
    given = ("experiment=kinematic_node", "effort=demo")
    sagemp("run", "--until", "train-tracker", *given)
    result = sagemp("verify", *given, "tracker.lookahead=7")
    assert result.exit_code == 2
    remake = "sagemp train-tracker experiment=kinematic_node effort=demo tracker.lookahead=7 --overwrite"
    assert f"remake it with '{remake}', drop the override" in result.stderr
    missing = sagemp("execute", *given).stderr
    assert "make it with 'sagemp build-library experiment=kinematic_node effort=demo'" in missing
    assert "(or 'sagemp run experiment=kinematic_node effort=demo'" in missing
    sagemp("gen-data", *given, "--overwrite")
    changed = sagemp("train-tracker", *given, "--overwrite").stderr
    assert "remake it with 'sagemp train-planner experiment=kinematic_node effort=demo --overwrite'" in changed


def test_a_hint_to_another_experiments_file_keeps_effort_and_folder(sagemp):
    result = sagemp("train-tracker", "experiment=planar_cfm", "effort=demo", "artifacts=there", "seed=3")
    assert result.exit_code == 2
    maker = "sagemp train-tracker experiment=planar_node effort=demo artifacts=there seed=3"
    assert f"planar_cfm takes tracker.h5 from planar_node; make it with '{maker}'" in result.stderr


def test_another_start_box_on_trained_files_is_answered_with_a_run_of_another_name_and_that_works(sagemp, made_up):
    sagemp("run")
    other = "start.radius=[0.5,0.5,0,0]"
    answer = "name=NAME sources.train-planner=unicycle_node sources.train-tracker=unicycle_node"
    refused = sagemp("verify", other, "--overwrite")
    assert refused.exit_code == 2
    assert f", or use it as it is in a run of another name: {answer}" in refused.stderr
    made_up.ran.clear()
    assert sagemp("run", other, *answer.replace("NAME", "mine").split()).exit_code == 0
    assert made_up.ran == ["verify", "build-library", "execute"]
    assert Path("artifacts/mine/certificate.h5").exists()


def test_a_run_with_a_name_of_its_own_can_be_a_source(sagemp, made_up):
    sagemp("run", "--until", "verify", "name=d1", "tracker.lookahead=7")
    made_up.ran.clear()
    given = ("name=d2", "sources.train-planner=d1", "sources.train-tracker=d1", "start.radius=[0.5,0.5,0,0]")
    result = sagemp("run", "--until", "verify", *given)
    assert result.exit_code == 0, result.stderr
    assert made_up.ran == ["verify"]
    assert "d1: train-tracker: up to date (artifacts/d1/tracker.h5)" in result.stdout
    assert sagemp("verify", *given).stdout.startswith("up to date")


@pytest.mark.parametrize("name", ["d9", "../unicycle_node", ".hidden", "d1/.."])
def test_a_source_that_names_nothing_is_refused(sagemp, made_up, name):
    sagemp("run", "--until", "train-tracker", "name=d1")
    result = sagemp("run", "name=d2", f"sources.train-tracker={name}")
    assert result.exit_code == 2
    assert f"sources.train-tracker: no experiment '{name}'" in result.stderr
    assert "no file of a run of that name" in result.stderr


def test_run_keeps_the_earlier_file_of_what_it_trains_again(sagemp, made_up):
    sagemp("run")
    before = (FOLDER / "tracker.h5").read_bytes()
    result = sagemp("run", "tracker.lookahead=7")
    assert (FOLDER / "tracker-before.h5").read_bytes() == before
    assert f"train-tracker: the earlier file is kept as {FOLDER}/tracker-before.h5" in result.stdout
    assert not (FOLDER / "certificate-before.h5").exists()


def test_run_does_not_replace_a_file_of_another_experiment_that_was_put_there_by_hand(sagemp, made_up):
    sagemp("run", "--until", "train-tracker", "name=other")
    sagemp("run", "--until", "train-planner")
    path = FOLDER / "tracker.h5"
    path.write_bytes(Path("artifacts/other/tracker.h5").read_bytes())
    before = path.read_bytes()
    result = sagemp("run")
    assert result.exit_code == 2
    assert f"error: {path}: is of 'other' and was put there by hand, 'sagemp run' does not replace it" in result.stderr
    assert "move it away, or say sources.train-tracker=other" in result.stderr
    assert path.read_bytes() == before


def test_the_certificate_of_a_file_of_references_is_not_the_experiments_own(sagemp, made_up):
    sagemp("run", "--until", "verify")
    before = (FOLDER / "certificate.h5").read_bytes()
    result = sagemp("verify", "verify.file=some/plans.npz")
    assert result.exit_code == 0, result.stderr
    assert f"certificate {FOLDER}/certificate-plans.h5" in result.stdout
    assert (FOLDER / "certificate.h5").read_bytes() == before
    assert sagemp("verify", "verify.file=some/plans.npz").stdout.startswith("up to date")


def test_stages_that_sample_take_another_seed_on_the_same_trained_files(sagemp, made_up):
    sagemp("run")
    made_up.ran.clear()
    for name in ("verify", "build-library", "execute"):
        result = sagemp(name, "--seed", "3", "--overwrite")
        assert result.exit_code == 0, result.stderr
    assert made_up.ran == ["verify", "build-library", "execute"]  # with a library that was drawn with another seed
    assert read_artifact(FOLDER / "rollouts.h5", Rollouts).header.seed == 3
    assert read_artifact(FOLDER / "tracker.h5", TrackerModel).header.seed == 0
    assert sagemp("verify", "--seed", "4").exit_code == 2  # nothing that exists is replaced unasked


@pytest.mark.parametrize("command", [("run", "--until", "verify"), ("verify",)])
def test_a_figure_that_is_missing_beside_a_file_that_is_up_to_date_is_drawn(sagemp, made_up, command):
    assert sagemp("run", "--until", "verify").exit_code == 0
    figure = Path("artifacts/unicycle_node/certificate.png")
    figure.unlink()
    ran = list(made_up.ran)
    result = sagemp(*command)
    assert result.exit_code == 0, result.stderr
    assert figure.exists()
    assert made_up.ran == ran
    assert f"figure {figure}" in result.stderr


def test_the_verdict_comes_with_the_share_of_further_plans_that_certify(sagemp, made_up):
    made_up.certificate["samples"] = Samples(drawn=20, certified=14, seed=3)
    sagemp("run", "--until", "train-tracker")
    result = sagemp("verify")
    assert "  further plans of the planner: 14 of 20 certify too (seed 3)" in result.stdout.splitlines()
    found = json.loads(sagemp("verify", "--json").stdout)
    assert found["samples"] == {"drawn": 20, "certified": 14, "seed": 3}
    made_up.certificate["samples"] = None
    assert "further plans" not in sagemp("verify", "--overwrite").stdout
