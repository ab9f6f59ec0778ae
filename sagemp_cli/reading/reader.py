"""The caller's side of a reader process: ask for a file, get arrays and texts, or one line that says why not."""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Collection
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np

from sagemp_cli.errors import ArtifactError
from sagemp_cli.reading import wire
from sagemp_cli.reading.budget import most_seconds
from sagemp_cli.reading.regular import require_regular
from sagemp_cli.reading.tree import Group

_ROOT = Path(__file__).resolve().parents[2]
_START = f"import sys; sys.path.insert(0, {str(_ROOT)!r}); from sagemp_cli.reading.process import main; main()"
_PATIENCE = 6
"""Seconds of waiting for each second of processor time: machines are busy."""
_SURROUNDINGS = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
_SURROUNDINGS |= {"HDF5_PLUGIN_PRELOAD": "::"}  # a file names filters by number: none is loaded from a folder


def read_tree(
    path: Path,
    *,
    what: str = "an HDF5 file",
    damaged: str = "not a readable HDF5 file",
    without: Collection[str] = (),
) -> tuple[Group, str]:
    """Everything in an HDF5 file, and the SHA-256 of its bytes.

    Args:
        path: the file.
        what, damaged: what it should be, and is not if it is damaged, for messages.
        without: names at the top whose content is not read; without such names, the hash is not made either.

    Raises:
        ArtifactError: one line: missing, no regular file, damaged, or more than may be read: see
            :mod:`sagemp_cli.reading.hdf5` and :mod:`sagemp_cli.reading.budget`.
    """
    request = {"format": "tree", "without": list(without), "hash": not without}
    found = _asked(path, request, what=what, damaged=damaged)
    return found["tree"], found["sha256"]


def read_arrays(path: Path, wanted: Collection[str] | None = None) -> tuple[list[str], dict[str, np.ndarray]]:
    """Names of what is at the top of an HDF5 or NPZ (.npz) file, and the ``wanted`` arrays among it (None: all).

    Raises:
        ArtifactError: as :func:`read_tree`; or one that is wanted is no array of numbers.
    """
    form = "npz" if path.suffix.lower() == ".npz" else "arrays"
    request = {"format": form, "wanted": None if wanted is None else list(wanted)}
    found = _asked(path, request, what="a file", damaged="cannot be read")
    return found["names"], found["arrays"]


def read_onnx(path: Path) -> dict[str, Any]:
    """What an ONNX file says, see :func:`sagemp_cli.reading.onnx_file.graph_of`.

    Raises:
        ArtifactError: as :func:`read_tree`; or it holds what a plain network does not have.
    """
    return _asked(path, {"format": "onnx"}, what="an ONNX file", damaged="not a readable ONNX file")["graph"]


def _asked(path: Path, request: dict[str, Any], *, what: str, damaged: str) -> dict[str, Any]:
    size = require_regular(path, what)
    request |= {"path": os.path.abspath(path), "damaged": damaged}
    answer = _READER.ask(request, seconds=_PATIENCE * most_seconds(size))
    if isinstance(answer, int):
        raise ArtifactError(f"{path}: {damaged} ({_end(answer, size)})")
    if "refused" in answer:
        raise ArtifactError(f"{path}: {answer['refused']}")
    return answer


def _end(code: int, size: int) -> str:
    """Why a reader process ended with a code."""
    if -code in (getattr(signal, "SIGXCPU", 0), getattr(signal, "SIGKILL", 0)):
        return f"reading it does not come to an end within {most_seconds(size)} s"
    return f"reading it ends the process that reads, with code {code}"


class _Reader:
    """One reader process, started when it is needed, ended when it fails to answer, and with this process."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._owner, self._lock = 0, threading.Lock()

    def ask(self, request: dict[str, Any], *, seconds: float) -> dict[str, Any] | int:
        """Its answer; or the exit code with which it ended instead."""
        with self._lock:
            process = self._running()
            assert process.stdin is not None and isinstance(process.stdout, BufferedReader)
            watch = threading.Timer(seconds, process.kill)
            watch.daemon = True
            watch.start()
            try:
                wire.send(process.stdin, request)
                return wire.receive(process.stdout)
            except (EOFError, OSError):
                code = process.wait()
                self.end()
                return code
            except BaseException:  # Ctrl-C or a time limit: half an answer is of no use
                self.end()
                raise
            finally:
                watch.cancel()

    def end(self) -> None:
        """End the process, if it is this one's."""
        process, self._process = self._process, None
        if process is None or self._owner != os.getpid():
            return
        process.kill()
        process.wait()
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):  # what was not written yet: nobody reads it
                    stream.close()

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is None or self._owner != os.getpid() or self._process.poll() is not None:
            self.end()
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", _START],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env=os.environ | _SURROUNDINGS,
            )
            self._owner = os.getpid()
        return self._process


_READER = _Reader()
atexit.register(_READER.end)
