"""What several folders of tests share: one small experiment run once, and made-up records of every kind."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def toy_root(tmp_path_factory) -> Path:
    """The folder that the toy experiment's artifacts were written below; treat it as read-only."""
    from sagemp_cli.config import compose
    from sagemp_cli.stages.stage import STAGES, StageContext

    root = tmp_path_factory.mktemp("artifacts")
    config = compose(["effort=toy", f"artifacts={root}"])
    for stage in STAGES:
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
                values[f.name] = {"str": "a text", "int": 7, "float": 0.25, "bool": True}[f.type]
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
