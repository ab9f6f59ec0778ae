"""Folders of unfinished work that runs at the same time share: who uses one says so, and nobody removes it then."""

from __future__ import annotations

import contextlib
import os
import shutil
from pathlib import Path

from sagemp_cli.errors import ResourceError

try:
    import fcntl
except ImportError:  # Windows: nobody can say so; the pieces of others are removed, and made again
    fcntl = None  # type: ignore[assignment]

_LOCK = ".in-use"


class Claim:
    """A folder that this process uses until :meth:`release`; runs of the same work share one."""

    def __init__(self, folder: Path) -> None:
        """Make the folder and claim it.

        Raises:
            ResourceError: it cannot be made.
        """
        self.folder, self._handle = folder, -1
        try:
            while not _is_at(self._handle, folder / _LOCK):  # another run may have removed it in between
                self.release()
                folder.mkdir(parents=True, exist_ok=True)
                with contextlib.suppress(FileNotFoundError):
                    self._handle = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o644)
                    _lock(self._handle, shared=True)
        except OSError as e:
            self.release()
            raise ResourceError(f"{folder.parent}: cannot be written: {e.strerror or e}") from e

    def remove(self) -> None:
        """Remove the folder, unless another run uses it, and the one that it is in, if nothing else is there."""
        self.release()
        remove_unused(self.folder)
        with contextlib.suppress(OSError):
            self.folder.parent.rmdir()

    def release(self) -> None:
        """Use it no longer."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1

    def __del__(self) -> None:
        self.release()


def remove_unused(folder: Path) -> None:
    """Remove a folder or file, unless a run uses it."""
    if not folder.is_dir() or folder.is_symlink():
        folder.unlink(missing_ok=True)
        return
    handle = -1
    try:
        with contextlib.suppress(FileNotFoundError):
            handle = os.open(folder / _LOCK, os.O_RDWR)
            if not _lock(handle, shared=False):
                return
        shutil.rmtree(folder, ignore_errors=True)
    finally:
        if handle >= 0:
            os.close(handle)


def _lock(handle: int, *, shared: bool) -> bool:
    """Lock without waiting for long; whether it worked. Where the file system has no locks, it counts as if it did."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(handle, fcntl.LOCK_SH if shared else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


def _is_at(handle: int, path: Path) -> bool:
    """Whether an open file is still the one under this name."""
    if handle < 0:
        return False
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path))
    except FileNotFoundError:
        return False
