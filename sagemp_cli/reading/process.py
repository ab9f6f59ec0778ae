"""The reader process: opens one file after another, each under its own limits, and hands over what is in it."""

from __future__ import annotations

import hashlib
import os
import signal
import stat
import sys
from io import BufferedReader
from typing import Any

import h5py
import numpy as np

from sagemp_cli.reading import wire
from sagemp_cli.reading.budget import Budget, RefusedError, most_seconds
from sagemp_cli.reading.hdf5 import datasets_of, tree_of
from sagemp_cli.reading.npz import arrays_of
from sagemp_cli.reading.onnx_file import graph_of

_MARGIN = 2**26


def main() -> None:
    """Answer requests on stdin until it ends."""
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    assert isinstance(requests, BufferedReader)
    os.dup2(2, 1)  # what a library prints is no answer
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the caller's, who ends this process
    while True:
        try:
            request = wire.receive(requests)
        except EOFError:
            return
        wire.send(answers, answer(request))


def answer(request: dict[str, Any], tries: int = 5) -> dict[str, Any]:
    """What is in a file, or ``{"refused": why}``; see :mod:`sagemp_cli.reading.reader` for the requests.

    A file that another run replaced meanwhile is read again, up to ``tries`` times in all.
    """
    try:
        with open_regular(request["path"]) as file:
            size = os.fstat(file.fileno()).st_size
            _limit(size)
            return _read(request, file, Budget(size))
    except _ReplacedError as e:
        return answer(request, tries - 1) if tries > 1 else {"refused": str(e)}
    except RefusedError as e:
        return {"refused": str(e)}
    except MemoryError:
        return {"refused": "it needs more memory than a file of its size may take"}
    except Exception as e:  # whatever a library makes of damaged bytes
        return {"refused": f"{request['damaged']} ({' '.join(str(e).split())[:500] or type(e).__name__})"}


def open_regular(path: str) -> BufferedReader:
    """Open a file for reading, without waiting for whoever writes into a pipe.

    Raises:
        RefusedError: it is a pipe, a device, a socket or a folder.
        OSError: it is not there or not readable.
    """
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    file = os.fdopen(handle, "rb")
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        file.close()
        raise RefusedError("is no regular file")
    return file


def _read(request: dict[str, Any], file: BufferedReader, budget: Budget) -> dict[str, Any]:
    wanted = request.get("wanted")
    match request["format"]:
        case "npz":
            names, arrays = arrays_of(file, budget, wanted)
            return {"names": names, "arrays": arrays}
        case "onnx":
            return {"graph": graph_of(file, budget)}
        case "arrays":
            with _hdf5(request["path"], file) as opened:
                names, arrays = datasets_of(opened, budget, wanted)
                return {"names": names, "arrays": arrays}
        case _:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest() if request["hash"] else ""
            with _hdf5(request["path"], file) as opened:
                return {"sha256": sha256, "tree": tree_of(opened, budget, without=request["without"])}


class _ReplacedError(RefusedError):
    """The name stands for another file now."""


class _hdf5:
    """The same file opened by the HDF5 library, which only takes names; one that was replaced meanwhile is refused."""

    def __init__(self, path: str, file: BufferedReader) -> None:
        self._before, self._path = os.fstat(file.fileno()), path
        self._file = h5py.File(path, "r", locking="best-effort")

    def __enter__(self) -> h5py.File:
        return self._file

    def __exit__(self, kind: type | None, *_: object) -> None:
        self._file.close()
        now = os.stat(self._path)
        same = [(s.st_dev, s.st_ino, s.st_size, s.st_mtime_ns) for s in (self._before, now)]
        if kind is None and same[0] != same[1]:
            raise _ReplacedError("was replaced while it was read; try again")


def _limit(size: int) -> None:
    """Bound what this process may take from here on, where the system can: what loops in C is then ended, too."""
    try:
        import resource
    except ImportError:  # Windows: the caller's clock alone
        return
    used = resource.getrusage(resource.RUSAGE_SELF)
    seconds = int(used.ru_utime + used.ru_stime) + 1 + most_seconds(size)
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, resource.getrlimit(resource.RLIMIT_CPU)[1]))
    taken = _address_space()
    if taken:  # what was unpacked, and once more while it is handed over
        most = taken + 2 * Budget(size).allowed + _MARGIN
        resource.setrlimit(resource.RLIMIT_AS, (most, resource.getrlimit(resource.RLIMIT_AS)[1]))


def _address_space() -> int:
    """Bytes of address space in use; 0 where the system does not tell."""
    try:
        with open("/proc/self/statm", "rb") as file:
            return int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        return 0


np.seterr(all="ignore")
