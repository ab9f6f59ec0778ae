"""What ``sagemp check`` prints of each kind of answer."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import h5py
import pytest

from sagemp_cli.checker.check import Finding, Report
from sagemp_cli.cli.check import as_lines
from sagemp_cli.storage.content import content_hash


def report(answer, *claims):
    """A report about references of which each is claimed to be as given, none of them proved."""
    fields = {f.name: None for f in dataclasses.fields(Finding)}
    findings = tuple(
        Finding(**fields | {"reference": i, "claimed": claim, "proved": False, "reason": "some reason"})
        for i, claim in enumerate(claims)
    )
    fields = {f.name: None for f in dataclasses.fields(Report)}
    known = {
        "path": Path("c.h5"),
        "answer": answer,
        "claimed": answer,
        "problems": (),
        "findings": findings,
        "counterexamples": (),
    }
    return Report(**fields | known | {"cells": 4, "horizon": 5, "seconds": 1.0, "proof_seconds": 0.0})


def test_a_proved_counterexample_is_called_proved():
    lines = as_lines(report("FALSIFIED", "UNSAFE", "MAY_COLLIDE"))
    assert lines[1:3] == [
        "  reference 0: UNSAFE: its counterexample is proved",
        "  reference 1: MAY_COLLIDE: some reason",
    ]


@pytest.mark.parametrize("claim", ["UNSAFE", "MAY_COLLIDE"])
def test_a_counterexample_that_is_not_proved_is_not_called_so(claim):
    assert as_lines(report("UNKNOWN", claim))[1] == f"  reference 0: {claim}: some reason"


def test_what_a_terminal_would_obey_is_not_printed(sagemp, toy_folder, tmp_path):
    path = tmp_path / "certificate.h5"
    shutil.copy(toy_folder / "certificate.h5", path)
    with h5py.File(path, "r+") as file:
        file["data"].attrs["verdict"] = "\x1b[2J\x1b[1;1HVERIFIED"
        file.attrs["content_sha256"] = content_hash(file)
    for command in ("check", "inspect"):
        result = sagemp(command, path)
        assert "VERIFIED" in result.output and "\x1b" not in result.output


@pytest.mark.parametrize("command", [("verify",), ("run", "--until", "verify")], ids=lambda c: c[0])
def test_no_figure_is_drawn_of_a_verdict_that_is_refused(command, sagemp, toy_folder, tmp_path):
    shutil.copytree(toy_folder, tmp_path / "artifacts" / toy_folder.name)
    path = tmp_path / "artifacts" / toy_folder.name / "certificate.h5"
    with h5py.File(path, "r+") as file:
        file["data/tubes/step"][...] = 3
        file.attrs["content_sha256"] = content_hash(file)
    path.with_suffix(".png").unlink(missing_ok=True)
    result = sagemp(*command, "effort=toy")
    assert result.exit_code == 2 and "is called SAFE, but a step" in result.stderr
    assert not path.with_suffix(".png").exists() and "figure" not in result.output
