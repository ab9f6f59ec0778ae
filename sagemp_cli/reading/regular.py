"""What is under a file's name: a pipe or a device there must not hold up who looks at it."""

from __future__ import annotations

import hashlib
import os
import stat
from pathlib import Path

from sagemp_cli.errors import ArtifactError

_OTHERS = (
    (stat.S_ISDIR, "is a folder"),
    (stat.S_ISFIFO, "is a pipe"),
    (stat.S_ISSOCK, "is a socket"),
    (stat.S_ISCHR, "is a device"),
    (stat.S_ISBLK, "is a device"),
)


def is_there(path: Path) -> bool:
    """Whether the name is taken, by whatever it be: also by a link to nothing."""
    return os.path.lexists(path)


def require_regular(path: Path, what: str = "a file") -> int:
    """The size of a regular file.

    Args:
        path: the file.
        what: what is needed there, for messages.

    Raises:
        ArtifactError: it is missing, a link to nothing, or something else than a file.
    """
    try:
        found = os.stat(path)
    except (FileNotFoundError, NotADirectoryError):
        if os.path.islink(path):
            raise ArtifactError(f"{path}: is a link to {os.readlink(path)}, which is not there") from None
        raise ArtifactError(f"{path}: no such file") from None
    except (OSError, ValueError) as e:
        raise ArtifactError(f"{path}: cannot be read ({getattr(e, 'strerror', None) or e})") from None
    if not stat.S_ISREG(found.st_mode):
        kind = next((text for test, text in _OTHERS if test(found.st_mode)), "is no file")
        raise ArtifactError(f"{path}: {kind}, {what} is needed")
    return found.st_size


def sha256_of(path: Path) -> str:
    """SHA-256 of a regular file's bytes, hexadecimal.

    Raises:
        ArtifactError: it is missing, unreadable or no regular file.
    """
    left = require_regular(path)
    digest = hashlib.sha256()
    try:
        with open(os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)), "rb") as file:
            while left > 0 and (block := file.read(min(left, 2**20))):  # as long as it says: some have no end
                digest.update(block)
                left -= len(block)
    except OSError as e:
        raise ArtifactError(f"{path}: cannot be read ({e.strerror or e})") from None
    return digest.hexdigest()


def sha256_if_there(path: Path) -> str | None:
    """The same of a file that may be gone; None if there is no file that can be read."""
    try:
        return sha256_of(path)
    except ArtifactError:
        return None
