"""Every experiment, planner and robot at toy size through the command line, from nothing to a verdict and its check."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from sagemp_cli.cli.main import app
from sagemp_cli.config.composition import options_of
from sagemp_cli.storage import Certificate, read_artifact

SMALL = {  # beside effort=toy: networks and training of planners that the neural ODE's sizes do not fit
    "planar_cfm": ("planner.width=16", "planner_training.steps=40"),
    "planar_diffusion": ("planner.width=16", "planner_training.steps=40"),
    "unicycle_node_learned": ("dynamics.hidden=[16,16]",),
    "quadrotor_diffusion": ("planner.width=16", "planner_training.steps=40"),
    "unicycle_vlm": ("planner_training.exercises=40", "planner_training.held_out=10", "planner_training.steps=30"),
    "unicycle_vlm_avoid": (
        "planner_training.exercises=40",
        "planner_training.held_out=10",
        "planner_training.steps=30",
    ),
}


@pytest.fixture(scope="module")
def artifacts(tmp_path_factory):
    """One folder for all, so that experiments find what they take from each other."""
    return tmp_path_factory.mktemp("artifacts")


def sagemp(*arguments):
    return CliRunner().invoke(app, arguments)


ELSEWHERE = ("unicycle_node", "unicycle_node_plain", "quadrotor_diffusion_continuous")
"""Tested in other files; or it takes files that are made smaller here than its experiment says."""


@pytest.mark.parametrize("name", [e for e in options_of("experiment") if e not in ELSEWHERE])
def test_an_experiment_runs_from_nothing_to_a_verdict(name, artifacts):
    overrides = (f"experiment={name}", "effort=toy", f"artifacts={artifacts}", *SMALL.get(name, ()))
    run = sagemp("run", *overrides, "--until", "verify")
    assert run.exit_code in (0, 5, 10), run.output
    certificate = artifacts / f"{name}-toy" / "certificate.h5"
    said = json.loads(sagemp("verify", *overrides, "--json").stdout)
    assert said["verdict"] == {0: "VERIFIED", 5: "UNKNOWN", 10: "FALSIFIED"}[run.exit_code]
    if run.exit_code == 0:
        assert sagemp("check", str(certificate)).exit_code == 0, "what was proved is proved again from the file alone"
    again = sagemp("run", *overrides, "--until", "verify")
    assert again.exit_code == run.exit_code and "making it" not in again.output, "everything is up to date"


def test_a_csv_of_positions_is_a_plan_that_another_experiments_tracker_can_prove(artifacts, tmp_path):
    times = 0.05 * np.arange(41)
    way = 0.5 - 0.5 * np.cos(np.pi * times / times[-1])
    rows = np.column_stack([times, 0.5 + way, np.ones_like(way)])
    np.savetxt(tmp_path / "plan.csv", rows, delimiter=",", header="t,px,pz", comments="")
    run = sagemp(
        "run",
        "--until",
        "verify",
        "experiment=planar_node",
        "name=mine",
        "planner=from_file",
        f"planner.path={tmp_path / 'plan.csv'}",
        "sources.train-tracker=planar_node",
        "effort=toy",
        f"artifacts={artifacts}",
    )
    assert run.exit_code in (0, 5, 10), run.output
    assert "gen-data" not in run.output.replace("planar_node: gen-data", ""), "a file needs no demonstrations"
    found = read_artifact(artifacts / "mine-toy" / "certificate.h5", Certificate).record.tubes.references
    assert np.allclose(found[0, :, 0], rows[:, 1], atol=1e-6)
