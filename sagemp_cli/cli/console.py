"""Progress on the console: bars with time left on a terminal, a plain line every few seconds elsewhere.

Progress goes to stderr, results to stdout, so that results can be piped.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress

from sagemp_cli.progress import Progress

QUIET_SECONDS = 2.0
"""Work that is done sooner leaves no line."""
LINE_EVERY_SECONDS = 5.0


def console_progress(stream: TextIO | None = None) -> Progress:
    """Bars if ``stream`` (stderr by default) is a terminal, plain lines otherwise."""
    out: TextIO = sys.stderr if stream is None else stream
    return TerminalProgress(out) if out.isatty() else PlainProgress(out)


class TerminalProgress:
    """Bars with time left; open tasks share one display."""

    def __init__(self, stream: TextIO) -> None:
        self._console = Console(file=stream)
        self._open = 0
        self._bars = RichProgress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(elapsed_when_finished=False),
            TextColumn("{task.fields[note]}", style="dim"),
            console=self._console,
            transient=True,
        )

    @contextmanager
    def task(self, description: str, total: int, done: int = 0) -> Iterator[_Bar]:
        """Show a bar while the block runs, and one plain line after it if it took long."""
        began = time.monotonic()
        if self._open == 0:
            self._bars.start()
        self._open += 1
        bar = self._bars.add_task(description, total=total, completed=done, note="")
        try:
            yield _Bar(self._bars, bar)
        finally:
            self._bars.remove_task(bar)
            self._open -= 1
            if self._open == 0:
                self._bars.stop()
        if time.monotonic() - began > QUIET_SECONDS:
            self.say(f"{description}: {total} done in {_span(time.monotonic() - began)}")

    def say(self, text: str) -> None:
        """Print one line above the bars."""
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)


class _Bar:
    def __init__(self, bars: RichProgress, task: TaskID) -> None:
        self._bars, self._task = bars, task

    def advance(self, steps: int = 1, note: str = "") -> None:
        fields: dict[str, Any] = {"note": note} if note else {}
        self._bars.update(self._task, advance=steps, **fields)


class PlainProgress:
    """Plain lines, at most one every few seconds, for logs and pipes."""

    def __init__(self, stream: TextIO, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._stream, self._clock = stream, clock
        self._told = clock()

    @contextmanager
    def task(self, description: str, total: int, done: int = 0) -> Iterator[_Lines]:
        """Print lines while the block runs, and a last one if it took long."""
        began = self._clock()
        yield _Lines(self, description, total, done, began)
        took = self._clock() - began
        if took > QUIET_SECONDS:
            self.say(f"{description}: {total} done in {_span(took)}")

    def say(self, text: str) -> None:
        """Print one line."""
        print(text, file=self._stream, flush=True)

    def due(self) -> bool:
        """Whether it is time for another line; then the clock starts anew."""
        now = self._clock()
        if now - self._told < LINE_EVERY_SECONDS:
            return False
        self._told = now
        return True

    def now(self) -> float:
        """Seconds on the clock."""
        return self._clock()


class _Lines:
    def __init__(self, progress: PlainProgress, description: str, total: int, done: int, began: float) -> None:
        self._progress, self._description, self._total = progress, description, total
        self._before, self._done, self._began = done, done, began

    def advance(self, steps: int = 1, note: str = "") -> None:
        self._done += steps
        if self._done >= self._total or not self._progress.due():
            return
        rate = (self._done - self._before) / max(self._progress.now() - self._began, 1e-9)
        left = f", {_span((self._total - self._done) / rate)} left" if rate > 0 else ""
        self._progress.say(f"{self._description}: {self._done}/{self._total}{left}{f', {note}' if note else ''}")


def _span(seconds: float) -> str:
    """A duration for people, e.g. ``1:05``."""
    whole = round(seconds)
    hours, minutes, rest = whole // 3600, whole // 60 % 60, whole % 60
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
