"""A limit on the time of a command, enforced the way Ctrl-C is, so that whatever resumes after one resumes.

A job in the background (``&`` in a script, nohup, cron) ignores Ctrl-C, not its time limit: there the signal is
listened to for as long as the limit runs, and heeded only when it is the limit that raised it.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sagemp_cli.errors import TimeLimitError, UsageError


@contextmanager
def time_limit(seconds: float | None) -> Iterator[None]:
    """Interrupt the block after ``seconds``; None sets no limit.

    Raises:
        TimeLimitError: the time ran out.
        UsageError: this system has no interval timers.
    """
    if seconds is None:
        yield
        return
    if not hasattr(signal, "setitimer"):
        raise UsageError("--time-limit is not available on this system")
    ran_out = False

    def ring(*_: Any) -> None:
        nonlocal ran_out
        ran_out = True
        signal.raise_signal(signal.SIGINT)

    def heed_the_limit(*_: Any) -> None:
        if ran_out:
            raise KeyboardInterrupt

    interrupt = signal.getsignal(signal.SIGINT)
    if not callable(interrupt):
        signal.signal(signal.SIGINT, heed_the_limit)
    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    except KeyboardInterrupt:
        if not ran_out:
            raise
        raise TimeLimitError(
            f"--time-limit {seconds:g} ran out: nothing half-written is left;"
            " run the same command again, finished pieces are not made twice"
        ) from None
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
        if not callable(interrupt) and interrupt is not None:
            signal.signal(signal.SIGINT, interrupt)
