"""Copies of the toy experiment that a test may change."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sagemp_cli.config.composition import compose
from sagemp_cli.pipeline.context import StageContext
from sagemp_cli.pipeline.stage import stage_named


def assert_same(a: Any, b: Any) -> None:
    """Two records hold the same bits, except for the seconds that were measured."""
    assert type(a) is type(b)
    if dataclasses.is_dataclass(a):
        for field in dataclasses.fields(a):
            if field.name != "seconds":
                assert_same(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for one, other in zip(a, b, strict=True):
            assert_same(one, other)
    elif isinstance(a, np.ndarray):
        np.testing.assert_array_equal(a, b)
    else:
        assert a == b


class Interrupt:
    """Progress that presses Ctrl-C once a task has advanced by so many steps, and remembers what it was told."""

    def __init__(self, after: int | None = None) -> None:
        self.after, self.resumed, self.advanced = after, {}, 0

    @contextmanager
    def task(self, description, total, done=0):
        self.resumed[description] = done
        yield self

    def advance(self, steps=1, note=""):
        self.advanced += steps
        if self.after is not None and self.advanced >= self.after:
            raise KeyboardInterrupt

    def say(self, text):
        pass


@pytest.fixture
def work(tmp_path, toy_folder) -> Callable[..., StageContext]:
    """``work(*stages)`` copies the outputs of these stages into a folder of the test's own and gives its context."""

    def prepare(*stages: str, overrides: tuple[str, ...] = (), **options) -> StageContext:
        config = compose(["effort=toy", f"artifacts={tmp_path}", *overrides])
        context = StageContext.of(config, **options)
        context.folder.mkdir(parents=True, exist_ok=True)
        for stage in stages:
            name = stage_named(stage).output
            if not (context.folder / name).exists():
                shutil.copy(Path(toy_folder) / name, context.folder / name)
        return context

    return prepare
