"""Copies of the toy experiment that a test may change."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path

import pytest

from sagemp_cli.config import compose
from sagemp_cli.stages.stage import StageContext, stage_named


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
