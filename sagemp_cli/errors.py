"""Errors for people and the exit codes they lead to.

Every error that a user can cause is a :class:`SagempError` whose message is one line: what was found,
what is allowed, and which file, key or option it is about. The command line prints that line and exits
with the code of the class; anything else is a bug of ours and exits with :data:`EXIT_ERROR`.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable

EXIT_CERTIFIED = 0
"""Success; for ``verify`` and ``check``: every reference is certified."""
EXIT_ERROR = 1
"""A bug of ours; please report it."""
EXIT_USAGE = 2
"""A wrong option, config key, input file or value; nothing was written."""
EXIT_UNKNOWN = 5
"""The proof did not succeed and no counterexample was found."""
EXIT_FALSIFIED = 10
"""A replayed counterexample shows that the claim is false."""
ANSWER_CODES = {"VERIFIED": EXIT_CERTIFIED, "FALSIFIED": EXIT_FALSIFIED, "UNKNOWN": EXIT_UNKNOWN}
"""Exit codes of the answers of ``verify`` and ``check``."""
EXIT_TIME_LIMIT = 124
"""A time limit given by the user ran out."""
EXIT_INTERRUPTED = 130
"""Interrupted by the user (Ctrl-C)."""


class SagempError(Exception):
    """Base of all errors that are reported to the user as one line."""

    exit_code = EXIT_ERROR


class UsageError(SagempError):
    """A wrong option, config key or value."""

    exit_code = EXIT_USAGE


class ConfigError(UsageError):
    """A config that cannot be composed or does not fit what it configures."""


class ArtifactError(UsageError):
    """An artifact that is missing, foreign, damaged, of another experiment, or in the way."""


class UnsupportedOperationError(UsageError):
    """A torch operation for which a propagator has no relaxation."""


class NonFiniteError(UsageError):
    """A NaN or an infinity where only finite numbers make sense."""


class ResourceError(UsageError):
    """The machine refuses: disk full, folder not writable, memory budget too small; nothing was written."""


class TubeWarning(UserWarning):
    """A tube is what it should be, but whoever reads it should know something about it."""


class TimeLimitError(SagempError):
    """A time limit given by the user ran out."""

    exit_code = EXIT_TIME_LIMIT


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return ``" (did you mean 'x'?)"`` for the nearest known name, or an empty string."""
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f" (did you mean '{near[0]}'?)" if near else ""
