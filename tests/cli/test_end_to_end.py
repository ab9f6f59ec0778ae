"""The real pipeline through the command line, on the toy experiment."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from sagemp_cli.errors import EXIT_INTERRUPTED, EXIT_UNKNOWN
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.sets import Tube


def test_verify_after_the_pipeline_prints_the_proof_of_its_certificate(sagemp, toy_root):
    result = sagemp("verify", "effort=toy", f"artifacts={toy_root}", "--partitions", "4", "--json")
    found = json.loads(result.stdout)
    assert result.exit_code == 0
    assert (found["verdict"], found["from_file"], found["rigorous"]) == ("VERIFIED", True, True)
    assert found["references"][0]["clearance"] > 0 and found["checkable"]


def test_verify_says_that_a_tube_without_recorded_relaxations_cannot_be_checked(sagemp, toy_folder, tmp_path):
    folder = tmp_path / toy_folder.name
    folder.mkdir()
    for name in ("demonstrations.h5", "planner.h5", "tracker.h5"):
        shutil.copy(toy_folder / name, folder)
    shown = sagemp("verify", "effort=toy", f"artifacts={tmp_path}", "--partitions", "4", "propagator=crown").stdout
    assert shown.startswith("VERIFIED")
    assert "nobody else can check it: propagator 'crown' records no relaxations, 'affine' does" in shown
    assert sagemp("check", folder / "certificate.h5").exit_code == EXIT_UNKNOWN


def test_run_after_the_pipeline_has_nothing_to_do(sagemp, toy_root):
    result = sagemp("run", "effort=toy", f"artifacts={toy_root}")
    assert result.exit_code == 0
    assert result.stdout.count(": up to date (") == 6
    assert f"certificate {toy_root}/unicycle_node-toy/certificate.h5" in result.stdout


def test_every_artifact_can_be_inspected(sagemp, toy_folder):
    for path in sorted(toy_folder.glob("*.h5")):
        found = json.loads(sagemp("inspect", "--json", path).stdout)
        assert found["experiment"] == "unicycle_node"
        assert all(parent["now"] == "unchanged" for parent in found["parents"])


def test_ctrl_c_ends_with_its_code_leaves_no_artifact_and_the_same_command_goes_on(tmp_path):
    command = [sys.executable, "-m", "sagemp_cli", "gen-data", "effort=toy", "expert.count=4", f"artifacts={tmp_path}"]
    folder = tmp_path / "unicycle_node-toy"
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        deadline = time.monotonic() + 90
        while not list(folder.glob(".demonstrations.partial/*/*.npz")) and time.monotonic() < deadline:
            assert process.poll() is None
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == EXIT_INTERRUPTED
    assert stderr.splitlines()[-1].startswith("interrupted: nothing half-written is left; run the same command again")
    assert [p.name for p in folder.iterdir()] == [".demonstrations.partial"]
    subprocess.run(command, check=True, capture_output=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    assert sorted(p.name for p in folder.iterdir()) == ["demonstrations.h5", "demonstrations.png"]


def test_doctor_finds_the_propagators_sound_and_names_versions(sagemp):
    result = sagemp("doctor", "--json")
    found = json.loads(result.stdout)
    assert result.exit_code == 0
    by_name = {p["name"]: p for p in found["propagators"]}
    assert by_name["affine"]["state"] == "sound"
    assert by_name["affine"]["rigorous"] is True
    assert by_name["auto_lirpa"]["state"] in ("sound", "not available")
    assert found["packages"]["torch"]
    assert "affine" in sagemp("doctor").stdout


@pytest.mark.parametrize("shrink", [0.9, 0.999])
def test_doctor_finds_a_propagator_that_loses_rollouts(sagemp, monkeypatch, shrink):
    right = Affine.propagate

    def wrong(self, loop, start, disturbance):
        tube = right(self, loop, start, disturbance)
        center, radius = (tube.lower + tube.upper) / 2, (tube.upper - tube.lower) / 2
        return Tube(center - shrink * radius, center + shrink * radius)

    monkeypatch.setattr(Affine, "propagate", wrong)
    result = sagemp("doctor", "--json")
    assert result.exit_code == 1
    states = {p["name"]: p["state"] for p in json.loads(result.stdout)["propagators"]}
    assert states["affine"] == "unsound"
