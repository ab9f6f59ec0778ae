"""The stage of docs/adding.md, word for word: a command, a file, a row of status, a step of run."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from sagemp_cli.plugins import stages

PAGE = (Path(__file__).parents[2] / "docs" / "adding.md").read_text(encoding="utf-8")
FOLDER = Path("artifacts/unicycle_node-toy")
FILE = FOLDER / "plan-lengths.h5"


@pytest.fixture
def documented(sagemp, made_up, monkeypatch):
    """``documented("status", ...)`` with the plugin of the page."""
    monkeypatch.setattr(stages, "_registered", {})
    monkeypatch.setattr(sys, "path", list(sys.path))
    text = next(block for block in re.findall(r"^```python\n(.*?)^```", PAGE, flags=re.S | re.M) if "@stage" in block)
    Path("plan_lengths.py").write_text(text)
    yield lambda *arguments: sagemp("--plugin", "plan_lengths.py", *arguments, "effort=toy")
    sys.modules.pop("plan_lengths", None)


def states(result):
    return {file["stage"]: file for file in json.loads(result.stdout)["files"]}


def test_it_is_a_command_a_file_and_a_node_of_the_graph(documented, sagemp, monkeypatch):
    from sagemp_cli.storage import Library, read_artifact

    assert sagemp("run", "effort=toy").exit_code == 0
    before = states(documented("status", "--json"))["plan-lengths"]
    assert (before["state"], before["inputs"]) == ("missing", ["build-library"])
    made = documented("plan-lengths", "+plan_lengths.scale=2")
    assert made.exit_code == 0 and made.stdout == f"wrote  {FILE}\n", made.stderr
    assert states(documented("status", "--json", "+plan_lengths.scale=2"))["plan-lengths"]["state"] == "fresh"
    stale = states(documented("status", "--json"))["plan-lengths"]
    assert stale["state"] == "stale" and "plan_lengths" in stale["why"]

    content = json.loads(sagemp("inspect", FILE, "--json").stdout)
    assert (content["kind"], [p["role"] for p in content["parents"]]) == ("plan-lengths", ["library"])
    assert [(f["name"], f["units"]) for f in content["fields"]] == [("length", "m")]
    places = read_artifact(FOLDER / "library.h5", Library).record.tubes.references[..., :2]
    expected = 2 * np.sqrt((np.diff(places, axis=1) ** 2).sum(axis=-1)).sum(axis=1)
    record = sys.modules["plan_lengths"].PlanLengths
    np.testing.assert_allclose(read_artifact(FILE, record).record.length, expected)

    monkeypatch.setattr(stages, "_registered", {})  # where the plugin is not known, its file is nothing
    unknown = sagemp("inspect", FILE)
    assert unknown.exit_code == 2 and "not an artifact of sagemp (schema 'sagemp/plan-lengths'" in unknown.stderr
    assert "No such command 'plan-lengths'" in sagemp("plan-lengths").stderr


def test_run_makes_it_and_until_names_it(documented):
    assert documented("run", "--until", "plan-lengths").exit_code == 0 and FILE.exists()
    assert "plan-lengths: up to date" in documented("run", "--dry-run").stdout


def test_its_help_is_its_docstring_and_the_list_of_commands_has_it(documented, sagemp):
    assert (
        "Measure how far the references of the library go."
        in sagemp("--plugin", "plan_lengths.py", "plan-lengths", "--help").stdout
    )
    assert "│ plan-lengths " in sagemp("--plugin", "plan_lengths.py", "--help").stdout


def test_the_plugins_of_a_project_need_no_option(documented, sagemp):
    Path("conf").mkdir()
    Path("conf/project.yaml").write_text("plugins: [plan_lengths.py]\n")
    assert "Measure how far the references of the library go." in sagemp("plan-lengths", "--help").stdout
    assert "plan-lengths" in states(sagemp("status", "--json", "effort=toy"))


def test_a_plugin_that_does_not_load_is_one_line_and_leaves_the_help(documented, sagemp):
    Path("conf").mkdir()
    Path("conf/project.yaml").write_text("plugins: [broken_lengths.py]\n")
    Path("broken_lengths.py").write_text("1 / 0\n")
    result = sagemp("plan-lengths")
    assert result.exit_code == 2
    assert result.stderr == "error: plugin broken_lengths.py: line 1: ZeroDivisionError: division by zero\n"
    assert "│ verify " in sagemp("--help").stdout


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("+plan_lengths.scal=2", "plan_lengths.scal: plan_lengths has no such option (did you mean 'scale'?)"),
        ("+plan_lengths.scale=-2", "plan_lengths.scale must be a positive number, found -2"),
    ],
)
def test_its_options_are_checked_like_all_others(documented, override, message):
    result = documented("plan-lengths", override)
    assert result.exit_code == 2 and message in result.stderr and not FILE.exists()


def test_what_goes_wrong_in_it_is_one_line_that_names_it(documented):
    Path("plan_lengths.py").write_text(
        Path("plan_lengths.py").read_text().replace("return PlanLengths", "return 1 / 0; PlanLengths")
    )
    assert documented("run", "--until", "build-library").exit_code == 0
    result = documented("plan-lengths")
    assert result.exit_code == 2 and not FILE.exists()
    assert result.stderr == "error: stage 'plan-lengths' of plan_lengths: ZeroDivisionError: division by zero\n"
