"""Progress of long work: bars with time left on a terminal, plain lines elsewhere, silence in libraries and tests."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol


class Task(Protocol):
    """One piece of work under way."""

    def advance(self, steps: int = 1, note: str = "") -> None:
        """Report that ``steps`` more units are done; ``note`` is a short figure shown beside the bar."""


class Progress(Protocol):
    """Where long work reports to. Core functions take one and default to :class:`Silent`."""

    def task(self, description: str, total: int, done: int = 0) -> AbstractContextManager[Task]:
        """Open a task of ``total`` units of which ``done`` were finished before (a resumed run)."""
        ...

    def say(self, text: str) -> None:
        """Print one line beside the bars."""


class _SilentTask:
    def advance(self, steps: int = 1, note: str = "") -> None:
        pass


class Silent:
    """Reports nothing."""

    @contextmanager
    def task(self, description: str, total: int, done: int = 0) -> Iterator[Task]:
        """Open a task that nobody watches."""
        yield _SilentTask()

    def say(self, text: str) -> None:
        """Print nothing."""
