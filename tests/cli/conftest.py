"""The command line with stages that are made up: they write example records at once."""

from __future__ import annotations

import copy
import dataclasses
import functools
import importlib
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from sagemp_cli.cli.main import app
from sagemp_cli.config import composition as config_module
from sagemp_cli.pipeline.stage import STAGES


@functools.cache
def _composed(overrides, surroundings, composed=config_module._composed):
    return composed(overrides)


@pytest.fixture(autouse=True)
def quick_config(monkeypatch):
    """Hydra composes each config once for all tests of this folder: it takes longer than everything else here."""

    def quick(overrides):
        return copy.deepcopy(_composed(tuple(overrides), config_module._surroundings()))

    monkeypatch.setattr(config_module, "_composed", quick)


@pytest.fixture
def sagemp(tmp_path, monkeypatch):
    """``sagemp("verify", "--partitions", "4")`` in an empty folder: ``exit_code``, ``stdout``, ``stderr``."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SAGEMP_DEBUG", raising=False)
    monkeypatch.setenv("COLUMNS", "200")
    runner = CliRunner()

    def call(*arguments):
        return runner.invoke(app, [str(a) for a in arguments], prog_name="sagemp")

    return call


@pytest.fixture
def made_up(monkeypatch, example):
    """Replace what every stage computes; ``ran`` lists the stages that ran, ``certificate`` is what verify writes."""
    state = SimpleNamespace(ran=[], certificate={"verdict": "VERIFIED"}, seed=0)

    def fake(stage):
        def run(context):
            parents = tuple(context.read(name) for name in stage.inputs_in(context.config))
            state.ran.append(stage.name)
            state.seed += 1  # every run writes another file
            record = example(stage.record, seed=state.seed, count=1, cells=4)
            if stage.name == "verify":
                safe = state.certificate["verdict"] == "VERIFIED"
                tubes = dataclasses.replace(
                    record.tubes,
                    verdict=("SAFE" if safe else "MAY_COLLIDE",),
                    step=np.array([-1 if safe else 17]),
                    fraction=np.array([0.0 if safe else 0.25]),
                    between="segments",
                    constraint=("" if safe else "lower disc",),
                    constraint_names=("workspace", "lower disc"),
                    clearance=np.array([[1.5, 0.25]]),
                )
                found = () if safe else record.counterexamples
                loop = dataclasses.replace(record.loop, lag=None)
                known = {
                    "true_model": None,
                    "loop": loop,
                } | state.certificate  # of an analytical robot
                record = dataclasses.replace(record, tubes=tubes, counterexamples=found, **known)
            return context.write(stage.name, record, parents)

        def draw(context):
            path = context.output_path(stage.name).with_suffix(".png")
            path.write_bytes(b"a figure")
            return path

        return run, draw

    monkeypatch.setattr("sagemp_cli.cli.verdict.rechecked", lambda certificate: "made up")  # its step is no program
    for stage in STAGES:
        module = importlib.import_module(f"sagemp_cli.stages.{stage.name.replace('-', '_')}")
        run, draw = fake(stage)
        monkeypatch.setattr(module, "run", run)
        monkeypatch.setattr(module, "draw", draw)
    return state
