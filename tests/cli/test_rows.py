"""Rows that fit a terminal of 80 columns, and one line each without spaces at the end in a pipe."""

import sys

import pytest

from sagemp_cli.cli import rows
from sagemp_cli.cli.doctor import _absent
from sagemp_cli.cli.rows import rows_of

CELLS = [("stage", "file"), ("verify", "certificate.h5")]


def test_a_note_stands_beside_its_row_if_all_fit():
    assert rows_of(CELLS, ["note", "short"], width=80) == [
        "stage   file            note",
        "verify  certificate.h5  short",
    ]
    assert rows_of(CELLS, ["", ""], width=80) == ["stage   file", "verify  certificate.h5"]
    assert rows_of([], [], width=80) == []


def test_notes_that_do_not_fit_stand_below_and_no_line_is_too_long():
    note = "was made with start.radius=[1.5, 1.5, 0.0, 0.0], this config says [0.5, 0.5, 0.0, 0.0] and more"
    lines = rows_of(CELLS, ["note", note], width=60)
    assert lines[:3] == ["stage   file", "    note", "verify  certificate.h5"]
    assert all(len(line) <= 60 for line in lines)
    assert " ".join(line.strip() for line in lines[3:]) == note
    assert len(rows_of(CELLS, ["note", note], width=None)) == 2


@pytest.mark.parametrize("command", [("status",), ("status", "tracker.lookahead=7"), ("config", "list")])
def test_commands_that_list_fit_80_columns(sagemp, made_up, monkeypatch, command):
    sagemp("run", "--until", "verify")
    monkeypatch.setattr(rows, "terminal_width", lambda: 80)
    for module in ("sagemp_cli.cli.status", "sagemp_cli.cli.config"):
        monkeypatch.setattr(sys.modules[module], "terminal_width", lambda: 80)
    shown = sagemp(*command).stdout.splitlines()
    assert max(map(len, shown)) <= 80
    assert all(line == line.rstrip() for line in shown)


@pytest.mark.parametrize("command", [("status", "tracker.lookahead=7"), ("config", "list")])
def test_in_a_pipe_every_row_is_one_line_without_spaces_at_its_end(sagemp, made_up, command):
    sagemp("run", "--until", "verify")
    shown = sagemp(*command).stdout.splitlines()
    assert all(line == line.rstrip() for line in shown)
    if command[0] == "status":
        assert len(shown) == 2 + 6


def test_doctor_does_not_call_a_propagator_sound_whose_package_it_calls_missing():
    assert "neuralsat carries" in _absent("auto_LiRPA", {"auto_LiRPA": None, "neuralsat": "0.2.17"})
    assert _absent("auto_LiRPA", {"auto_LiRPA": None, "neuralsat": None}) == "not installed"
    assert _absent("python-flint", {"neuralsat": "0.2.17"}) == "not installed"
