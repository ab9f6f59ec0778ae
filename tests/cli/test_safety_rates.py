"""``sagemp safety-rates``: rates of one experiment, and the table of all."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from sagemp_cli.storage import Header, SafetyRates, Trials, write_artifact

FOLDER = Path("artifacts/unicycle_node")


def trials(clear: list[list[float]], reached: bool = True) -> Trials:
    """Two references with two rollouts under each of three kinds of disturbance."""
    clearance = np.repeat(np.array(clear)[:, :, None], 2, axis=2)
    return Trials(clearance=clearance, reached=np.full((2, 3, 2), reached), nearest=np.zeros((2, 3, 6, 4)))


@pytest.fixture
def stored(example):
    """``stored(folder, experiment)``: a safety.h5 of known rates in ``artifacts/<folder>``."""

    def store(folder: str, experiment: str) -> Path:
        record = dataclasses.replace(
            example(SafetyRates, count=2, kinds=3, rollouts=2),
            disturbances=("none", "random", "worst case"),
            open_loop=trials([[0.5, 0.1, -0.1], [0.2, -0.3, -np.inf]], reached=False),
            closed_loop=trials([[0.5, 0.4, 0.3], [0.5, 0.4, 0.0]]),
            verdict=("SAFE", "MAY_COLLIDE"),
        )
        path = Path("artifacts") / folder / "safety.h5"
        return write_artifact(path, record, Header(stage="safety-rates", experiment=experiment, config={}))

    return store


def test_the_table_counts_references_and_rollouts_beside_the_paper(sagemp, stored):
    stored("planar_diffusion", "planar_diffusion")
    stored("unicycle_node-toy", "unicycle_node")
    result = sagemp("safety-rates", "--table")
    assert result.exit_code == 0
    head, *lines = ([c.strip() for c in line.split("  ") if c.strip()] for line in result.stdout.splitlines())
    kinds = ["w none", "w random", "w worst case"]
    assert head == ["experiment", "execution", "references safe", "and at goal", *kinds, "paper"]
    opened, closed, proved = lines[:3]
    first = ["planar_diffusion", "open loop", "0 % (0 of 2)", "0 %", "100 %", "50.0 %", "0 %", "78.5 % of 126"]
    assert opened == first
    assert closed == ["closed loop", "50.0 % (1 of 2)", "50.0 %", "100 %", "100 %", "50.0 %", "94.4 % of 126"]
    # Touching is not safe; of the certified reference every rollout is.
    assert proved == ["certified", "50.0 % (1 of 2)", "50.0 %", "100 %", "100 %", "100 %", "100 % of 126"]
    assert lines[3][:2] == ["unicycle_node-toy", "open loop"]
    assert "paper" not in str(lines[3]) and "126" not in str(lines[3:6])
    assert "A reference is safe if all its rollouts are" in " ".join(result.stdout.split())


def test_the_table_as_json(sagemp, stored):
    stored("planar_cfm", "planar_cfm")
    rows = json.loads(sagemp("safety-rates", "--table", "--json").stdout)
    assert [row["way"] for row in rows] == ["open loop", "closed loop", "certified"]
    assert rows[1] == {
        "experiment": "planar_cfm",
        "way": "closed loop",
        "sampled": 2,
        "rollouts": 2,
        "safe": 1,
        "reaching": 1,
        "rollouts_safe": {"none": 1.0, "random": 1.0, "worst case": 0.5},
        "paper": 0.815,
        "paper_sampled": 108,
    }


def test_without_certified_references_there_are_no_rollouts_of_them(sagemp, stored, example, monkeypatch):
    path = stored("odd", "odd")
    from sagemp_cli.storage import read_artifact

    found = read_artifact(path, SafetyRates)
    record = dataclasses.replace(found.record, verdict=("UNBOUNDED", "MAY_COLLIDE"))
    write_artifact(path, record, found.header, overwrite=True)
    row = json.loads(sagemp("safety-rates", "--table", "--json").stdout)[2]
    assert (row["safe"], row["rollouts_safe"]) == (0, {"none": None, "random": None, "worst case": None})
    assert "certified    0 % (0 of 2)" in sagemp("safety-rates", "--table").stdout


def test_the_table_of_nothing_says_how_to_make_something(sagemp):
    result = sagemp("safety-rates", "--table")
    assert result.exit_code == 2
    assert result.stderr == (
        "error: artifacts: no experiment has a safety.h5; make one with 'sagemp safety-rates experiment=NAME'\n"
    )


def test_the_table_of_another_folder(sagemp, stored):
    stored("planar_cfm", "planar_cfm")
    Path("artifacts").rename("elsewhere")
    assert "planar_cfm" in sagemp("safety-rates", "--table", "artifacts=elsewhere").stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["experiment=planar_cfm"], "experiment=planar_cfm has no effect on it, artifacts=DIR has"),
        (["--seed", "3"], "seed=3 has no effect on it"),
        (["--partitions", "2x2"], "proof.partitions='2x2' has no effect on it"),
        (["--overwrite"], "--table only reads what there is"),
        (["--dry-run"], "--table only reads what there is"),
        (["--time-limit", "5"], "--table only reads what there is"),
    ],
)
def test_the_table_refuses_what_would_have_no_effect(sagemp, stored, arguments, message):
    stored("planar_cfm", "planar_cfm")
    result = sagemp("safety-rates", "--table", *arguments)
    assert result.exit_code == 2
    assert message in result.stderr


def test_a_damaged_file_is_named(sagemp, stored):
    path = stored("planar_cfm", "planar_cfm")
    path.write_bytes(b"no HDF5 at all")
    result = sagemp("safety-rates", "--table")
    assert result.exit_code == 2
    assert f"error: {path}: not a readable HDF5 file" in result.stderr


def test_the_rates_of_the_toy_experiment_are_printed_from_its_file(sagemp, toy_root):
    result = sagemp("safety-rates", "effort=toy", f"artifacts={toy_root}")
    assert result.exit_code == 0, result.stderr
    assert "unicycle_node-toy  open loop" in result.stdout
    assert result.stdout.splitlines()[-1] == f"figure {toy_root}/unicycle_node-toy/safety.png"


def test_the_stage_through_the_command_line(sagemp, toy_folder):
    folder = Path("artifacts/unicycle_node-toy")
    folder.mkdir(parents=True)
    for name in ("demonstrations", "planner", "tracker"):
        shutil.copy(toy_folder / f"{name}.h5", folder)
    call = ("safety-rates", "effort=toy", "safety.references=2", "safety.rollouts=2", "executor=serial")
    dry = sagemp(*call, "--dry-run")
    assert dry.stdout.splitlines() == [
        "sagemp safety-rates would",
        f"  read     {folder}/planner.h5 (fresh)",
        f"  read     {folder}/tracker.h5 (fresh)",
        f"  write    {folder}/safety.h5",
    ]
    result = sagemp(*call, "--json")
    assert result.exit_code == 0, result.stderr
    rows = json.loads(result.stdout)
    assert [row["sampled"] for row in rows] == [2, 2, 2]
    assert rows[2]["safe"] <= rows[1]["reaching"] <= rows[1]["safe"]
    assert (folder / "safety.png").exists()
    before = (folder / "safety.h5").read_bytes()
    assert json.loads(sagemp(*call, "--json").stdout) == rows
    assert sagemp(*call, "--dry-run").stdout.startswith("sagemp safety-rates would print the rates of")
    other = sagemp(*call, "--seed", "1")
    assert other.exit_code == 2
    stale = sagemp("safety-rates", "effort=toy", "safety.references=3", "safety.rollouts=2", "executor=serial")
    assert "is stale (was made with safety.references=2, this config says 3); pass --overwrite" in stale.stderr
    assert (folder / "safety.h5").read_bytes() == before


def test_a_missing_input_names_the_command_that_makes_it(sagemp):
    result = sagemp("safety-rates")
    assert result.exit_code == 2
    assert f"error: {FOLDER}/planner.h5: missing; make it with 'sagemp train-planner'" in result.stderr


def test_an_unknown_key_of_its_section_is_refused(sagemp):
    result = sagemp("safety-rates", "+safety.rolouts=3")
    assert result.exit_code == 2
    assert "safety.rolouts: no such option (did you mean 'rollouts'?)" in result.stderr


def test_run_until_it_says_that_it_is_not_among_the_stages_of_run(sagemp):
    result = sagemp("run", "--until", "safety-rates")
    assert result.exit_code == 2
    assert "--until safety-rates: unicycle_node has no such stage; it has gen-data, " in result.stderr
