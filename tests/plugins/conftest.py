"""Folders with plugins in them, which are forgotten after each test."""

from __future__ import annotations

import sys

import pytest

from sagemp_cli.plugins import registry, stages


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The working directory of the test; what it registers and imports is forgotten."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "_registered", dict(registry._registered))
    monkeypatch.setattr(stages, "_registered", dict(stages._registered))
    monkeypatch.setattr(sys, "path", list(sys.path))
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if str(tmp_path) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


PLANNER = """
from sagemp_cli.plugins import planner

@planner("{name}")
def plan(start, goal, scene, count, generator, *, horizon: int, bulge: float = 0.0):
    return start[:, None].expand(count, horizon + 1, -1)
"""


@pytest.fixture
def write_planner(folder):
    """``write_planner(path, name)`` writes a plugin with a planner of this name."""

    def write(path, name):
        file = folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(PLANNER.format(name=name))
        return file

    return write
