"""What several folders of tests share: one small experiment run once, and made-up records of every kind."""

from __future__ import annotations

import dataclasses
import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

torch.set_num_threads(1)
# Started in the background the tests would inherit that Ctrl-C is ignored, and those of Ctrl-C could not press it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


SLOW = """
    checker/test_flow_mutants checker/test_mutants checker/test_program_mutants cli/test_check cli/test_end_to_end
    cli/test_every_experiment cli/test_init cli/test_own_stage cli/test_pipeline_commands cli/test_safety_rates
    experts/test_parallel planners/test_generative planners/test_planner_training report/test_figures
    report/test_safety stages/test_own_trackers stages/test_pipeline stages/test_reference_file
    stages/test_resume stages/test_safety_rates stages/test_train_dynamics stages/test_train_planner
    trackers/test_tube_loss verification/executors/test_cluster verification/executors/test_processes
    cli/test_errors::test_config_validate_checks_every_option
    reachability/continuous/test_reach::test_what_escapes_within_a_period_ends_the_tube_there_and_says_so
    reachability/crown/test_blocks::test_many_cells_of_a_wide_network_take_the_memory_of_a_few
    reachability/test_reach::test_a_first_call_imports_no_symbolic_mathematics
    reachability/test_reach::test_auto_lirpa_takes_a_strangers_loop
    reachability/test_reach::test_no_function_of_torch_that_is_given_a_value_kills_the_interpreter
    storage/test_artifact::test_random_damage_never_escapes_as_anything_but_a_one_line_error
"""
"""Whole pipelines, trainings, worker processes and campaigns: what ``make test-fast`` leaves out. Files, and of
others the tests that take seconds each (``pytest --durations=50`` says which)."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of slow files, and slow tests of others."""
    root, slow = Path(__file__).parent, set(SLOW.split())
    for name in slow:
        file, _, test = name.partition("::")
        assert f"def {test}" in (root / f"{file}.py").read_text(encoding="utf-8"), f"SLOW names no test: {name}"
    for item in items:
        file = item.path.relative_to(root).with_suffix("").as_posix()
        if file in slow or f"{file}::{item.name.partition('[')[0]}" in slow:
            item.add_marker("slow")


@pytest.fixture(scope="session")
def toy_root(tmp_path_factory) -> Path:
    """The folder that the toy experiment's artifacts were written below; treat it as read-only."""
    from sagemp_cli.config.composition import compose
    from sagemp_cli.pipeline.context import StageContext
    from sagemp_cli.pipeline.stage import STAGES

    root = tmp_path_factory.mktemp("artifacts")
    config = compose(["effort=toy", f"artifacts={root}"])
    for stage in STAGES:
        if stage.applies(config):
            stage.run(StageContext.of(config))
    return root


@pytest.fixture
def toy_folder(toy_root) -> Path:
    """The folder of the toy experiment's artifacts; treat it as read-only."""
    return toy_root / "unicycle_node-toy"


SIZES = {"count": 3, "K": 5, "n": 4, "m": 2, "cells": 6, "queries": 2, "rollouts": 4, "d": 4}


def example_of(record: type, rng: np.random.Generator, sizes: dict[str, int]) -> Any:
    """A record with random content that fits its declaration."""

    def shape(dims: tuple[str, ...]) -> tuple[int, ...]:
        parts = [re.fullmatch(r"([A-Za-z_]+)([+-]\d+)?", d).groups() for d in dims]
        return tuple(sizes.setdefault(name, 2) + int(shift or 0) for name, shift in parts)

    values: dict[str, Any] = {}
    for f in dataclasses.fields(record):
        meta = f.metadata
        match meta["form"]:
            case "array":
                raw = rng.normal(size=shape(meta["dims"])) * 3
                values[f.name] = (raw > 0) if meta["dtype"] == "bool" else raw.astype(meta["dtype"])
            case "texts":
                words = ["LR", "", "größer als µ", "SAFE"]
                values[f.name] = tuple(words[int(i)] for i in rng.integers(0, 4, shape(meta["dims"])[0]))
            case "weights":
                values[f.name] = {"layers.0.weight": rng.normal(size=(2, 3)), "layers.0.bias": rng.normal(size=2)}
            case "scalar":
                values[f.name] = {"str": "a text", "int": 7, "float": 0.25, "bool": True}[
                    f.type.removesuffix(" | None")
                ]
            case "group" if meta["many"]:
                values[f.name] = tuple(example_of(meta["record"], rng, dict(sizes)) for _ in range(2))
            case "group":
                values[f.name] = example_of(meta["record"], rng, sizes)
    return record(**values)


@pytest.fixture
def example() -> Callable[..., Any]:
    """``example(RecordClass)`` or ``example(RecordClass, seed=3, count=0)`` with sizes of dimensions."""

    def make(record: type, *, seed: int = 0, **sizes: int) -> Any:
        return example_of(record, np.random.default_rng(seed), SIZES | sizes)

    return make


LEARNED_UNICYCLE = {
    "name": "learned",
    "hidden": [4, 4],
    "activation": "tanh",
    "inputs": ["theta", "v"],
    "model": {
        "name": "unicycle",
        "dt": 0.1,
        "control_lower": [-9.0, -9.0],
        "control_upper": [9.0, 9.0],
        "state_lower": [-9.0, -9.0, -9.0, -9.0],
        "state_upper": [9.0, 9.0, 9.0, 9.0],
    },
}
"""Section of a robot whose weights :func:`learned_unicycle` makes by hand."""


def learned_unicycle_of(section: Any = LEARNED_UNICYCLE, *, scale: float = 0.1, drift: float = 0.0) -> Any:
    """A network that is nearly ``px' = v + drift, py' = theta, theta' = u_1, v' = u_2``, and not quite: hidden values
    are ``tanh(scale z) ~ scale z``. Near heading 0 and speed 1 it is a fair model of a unicycle, up to the drift.
    """
    import torch

    from sagemp_cli.config.binding import build

    robot = build(section, "dynamics")
    first, second, last = robot.layers
    with torch.no_grad():
        for layer in robot.layers:
            layer.weight.zero_()
            layer.bias.zero_()
        first.weight[range(4), range(2, 6)] = scale
        second.weight.copy_(torch.eye(4))
        last.weight[[0, 1, 2, 3], [1, 0, 2, 3]] = 1.0 / scale
        last.bias[0] = drift
    return robot


@pytest.fixture
def learned_unicycle() -> Callable[..., Any]:
    """:func:`learned_unicycle_of`."""
    return learned_unicycle_of
