"""Progress: plain lines now and then for logs, bars for terminals."""

from __future__ import annotations

import io

from sagemp_cli.cli.console import PlainProgress, TerminalProgress, console_progress


class Clock:
    def __init__(self):
        self.seconds = 0.0

    def __call__(self):
        return self.seconds


def test_plain_progress_prints_at_most_one_line_every_five_seconds_with_the_time_left():
    stream, clock = io.StringIO(), Clock()
    progress = PlainProgress(stream, clock=clock)
    with progress.task("training", 100) as task:
        for _ in range(100):
            clock.seconds += 0.25
            task.advance(note="loss 0.5")
    assert stream.getvalue().splitlines() == [
        "training: 20/100, 0:20 left, loss 0.5",
        "training: 40/100, 0:15 left, loss 0.5",
        "training: 60/100, 0:10 left, loss 0.5",
        "training: 80/100, 0:05 left, loss 0.5",
        "training: 100 done in 0:25",
    ]


def test_short_work_leaves_no_line():
    stream, clock = io.StringIO(), Clock()
    with PlainProgress(stream, clock=clock).task("quick", 3) as task:
        task.advance(3)
    assert stream.getvalue() == ""


def test_the_time_left_of_resumed_work_counts_only_what_was_done_now():
    stream, clock = io.StringIO(), Clock()
    with PlainProgress(stream, clock=clock).task("resumed", 100, done=90) as task:
        clock.seconds += 10
        task.advance(5)
    assert stream.getvalue().splitlines()[0] == "resumed: 95/100, 0:10 left"


def test_hours_are_shown_as_such():
    stream, clock = io.StringIO(), Clock()
    with PlainProgress(stream, clock=clock).task("long", 10) as task:
        clock.seconds += 3600
        task.advance(1)
    assert "long: 1/10, 9:00:00 left" in stream.getvalue()


def test_an_interrupted_task_does_not_claim_to_be_done():
    stream, clock = io.StringIO(), Clock()
    try:
        with PlainProgress(stream, clock=clock).task("training", 100):
            clock.seconds += 10
            raise KeyboardInterrupt
    except KeyboardInterrupt:
        pass
    assert stream.getvalue() == ""


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_terminal_gets_bars_that_end_when_the_work_does(monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    stream = Terminal()
    progress = console_progress(stream)
    assert isinstance(progress, TerminalProgress)
    with progress.task("outer", 2) as outer, progress.task("inner", 4, done=1) as inner:
        inner.advance(3, "loss 1")
        outer.advance(2)
    progress.say("a line with [brackets]")
    assert "inner" in stream.getvalue()
    assert "a line with [brackets]" in stream.getvalue()


def test_a_pipe_gets_plain_lines():
    assert isinstance(console_progress(io.StringIO()), PlainProgress)
