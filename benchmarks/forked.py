"""One command of ``sagemp`` in a process of its own, forked from this one, and what it took.

Importing torch and its like takes a second and more, a command on a small file a tenth of that. So this process imports
the whole package once, composes the configs that are asked for again and again, may run commands itself to warm up, and
*forks* for every command: what is measured is the command without that. It is ``main`` with its own arguments, folder,
streams and limits, and its reader is a process of its own, under its own limits, but forked as well. ``fresh`` runs the
same command from nothing, by the interpreter.
"""

from __future__ import annotations

import atexit
import contextlib
import copy
import gc
import importlib
import io
import json
import os
import pkgutil
import resource
import select
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
ROOT = Path(__file__).resolve().parents[1]
MOST_ADDRESSES = 2**33
"""Bytes of address space of a command: far more than it may take, so that the machine lives through what does."""


@dataclass(frozen=True)
class Ended:
    """How a command ended.

    Attributes:
        code: exit code; the negative number of the signal that killed it.
        output: what it wrote on both streams, its end if that is long.
        wall, processor: seconds, those of its reader among them.
        memory: peak of its resident memory in bytes, all that it was forked with included.
        reader: that of its reader process, as if it had been started alone; 0 without one, or with one that ended by
            itself.
        late: whether it was killed for it.
        said: what was reported of it.
    """

    code: int
    output: str
    wall: float
    processor: float
    memory: int
    reader: int
    late: bool = False
    said: Mapping[str, Any] = field(default_factory=dict)


def preload(configs: Sequence[Sequence[str]], commands: Sequence[Sequence[str]]) -> None:
    """Import the package, all of it that runs in the commands' own process, compose configs, and run commands once.

    Args:
        configs: overrides of each.
        commands: arguments of each; they run in this process and folder.

    Raises:
        RuntimeError: this process has more than one thread, so a fork of it may hang.
    """
    import sagemp_cli

    for module in pkgutil.walk_packages(sagemp_cli.__path__, "sagemp_cli."):
        if not any(part in module.name for part in (".lirpa", "__main__", "reading.process")):
            importlib.import_module(module.name)
    for name in ("hydra", "omegaconf", "pydantic", "rich.table", "rich.console", "matplotlib.pyplot", "yaml", "scipy"):
        importlib.import_module(name)
    importlib.import_module("torch").set_num_threads(1)
    _compose_once(configs)
    _warm_up(commands)
    gc.collect()
    gc.freeze()  # or a collection in a fork would copy all of it
    if len(os.listdir("/proc/self/task")) > 1:
        raise RuntimeError(f"this process has threads: {threading.enumerate()}")


def _warm_up(commands: Sequence[Sequence[str]]) -> None:
    import typer.main

    from sagemp_cli.cli import main
    from sagemp_cli.reading import reader

    main.app = typer.main.get_command(main.app)  # it is built anew with every call otherwise
    for arguments in commands:
        sys.argv = ["sagemp", *arguments]
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            try:
                main.main()
            except SystemExit as e:
                if e.code not in (0, None):
                    raise RuntimeError(f"sagemp {' '.join(arguments)} ended with {e.code}") from None
    reader._READER.end()


def _compose_once(configs: Sequence[Sequence[str]]) -> None:
    from sagemp_cli.config import composition

    made, compose = {}, composition._composed

    def noted(overrides: Sequence[str]) -> dict[str, Any]:
        made[tuple(overrides)] = compose(overrides)
        return made[tuple(overrides)]

    def remembered(overrides: Sequence[str]) -> dict[str, Any]:
        known = made.get(tuple(overrides))
        return compose(overrides) if known is None else copy.deepcopy(known)

    composition._composed = noted
    for overrides in configs:
        composition.compose(overrides)
    composition._composed = remembered


def command(arguments: Sequence[str], folder: Path, *, seconds: float, wall: float, fresh: bool = False) -> Ended:
    """``sagemp ARGUMENTS`` in a folder.

    Args:
        arguments: of the command line.
        folder: where it runs.
        seconds: processor time after which the system ends it.
        wall: seconds after which it is killed.
        fresh: whether it starts from nothing.
    """
    return forked(lambda report: _run(arguments, report, fresh), folder, seconds=seconds, wall=wall)


def forked(work: Callable[[int], None], folder: Path, *, seconds: float, wall: float) -> Ended:
    """Do something in a fork of this process: ``work(report)``, which may write a line of JSON to that descriptor."""
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as report:
        began, child = time.monotonic(), os.fork()
        if child == 0:
            _be_the_child(work, folder, output.fileno(), report.fileno(), seconds)
        late = not _ended(child, wall)
        if late:
            os.kill(child, signal.SIGKILL)
        _, status, used = os.wait4(child, 0)
        took = time.monotonic() - began
        _end_the_rest(child)
        report.seek(0)
        said = json.loads(report.read() or b"{}")
        output.seek(max(0, output.seek(0, os.SEEK_END) - 2**20))
        return Ended(
            code=os.waitstatus_to_exitcode(status),
            output=output.read().decode("utf-8", "replace"),
            wall=took,
            processor=used.ru_utime + used.ru_stime,
            memory=said.get("memory", used.ru_maxrss * 1024),
            reader=said.get("reader", 0),
            late=late,
            said=said,
        )


def _end_the_rest(group: int) -> None:
    """End what a killed command left running: its reader."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(group, signal.SIGKILL)


def _ended(child: int, wall: float) -> bool:
    """Whether a child ends within so many seconds."""
    handle = os.pidfd_open(child)
    try:
        return bool(select.select([handle], [], [], wall)[0])
    finally:
        os.close(handle)


def _be_the_child(work: Callable[[int], None], folder: Path, output: int, report: int, seconds: float) -> None:
    code = 70
    try:
        atexit._clear()  # of this process, not of the command
        os.setpgid(0, 0)
        os.chdir(folder)
        nothing = os.open(os.devnull, os.O_RDONLY)
        os.dup2(nothing, 0)
        os.dup2(output, 1)
        os.dup2(output, 2)
        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds) + 5))
        resource.setrlimit(resource.RLIMIT_AS, (MOST_ADDRESSES, resource.RLIM_INFINITY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        work(report)
        code = 0
    except SystemExit as e:
        code = e.code if isinstance(e.code, int) else int(e.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        try:
            atexit._run_exitfuncs()
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(code)


def _run(arguments: Sequence[str], report: int, fresh: bool) -> None:
    if fresh:
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        os.execve(sys.executable, [sys.executable, "-m", "sagemp_cli", *arguments], environment)
    from sagemp_cli.cli.main import main
    from sagemp_cli.reading import reader

    end, peaks = reader._READER.end, [0]

    def measured() -> None:
        process = reader._READER._process
        if isinstance(process, _ForkedReader) and reader._READER._owner == os.getpid():
            peak = memory_of(process.pid, "VmHWM")
            peaks.append(peak and peak - process.began_with + LONE_READER)
        end()

    def say() -> None:
        os.write(report, json.dumps({"memory": memory_of(os.getpid(), "VmHWM"), "reader": max(peaks)}).encode())

    reader._READER.end = measured
    reader.subprocess = SimpleNamespace(Popen=_ForkedReader, PIPE=None, DEVNULL=None)
    atexit.register(say)  # runs after the reader's end
    atexit.register(measured)
    sys.argv = ["sagemp", *arguments]
    main()


LONE_READER = 45 << 20
"""Resident memory of a reader process that has read nothing, started by itself."""


class _ForkedReader:
    """A reader process that is a fork of this one, where ``subprocess.Popen`` would start one."""

    def __init__(self, *_: Any, **__: Any) -> None:
        theirs, mine = os.pipe(), os.pipe()
        sys.stdout.flush()
        self.pid = os.fork()
        if self.pid == 0:
            self._read(theirs[0], mine[1], (theirs[1], mine[0]))
        os.close(theirs[0])
        os.close(mine[1])
        self.stdin, self.stdout = os.fdopen(theirs[1], "wb"), os.fdopen(mine[0], "rb")
        self.began_with = memory_of(self.pid, "VmRSS")
        self._code: int | None = None

    def _read(self, requests: int, answers: int, others: Sequence[int]) -> None:
        try:
            os.dup2(requests, 0)
            os.dup2(answers, 1)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            for handle in (requests, answers, *others):
                os.close(handle)
            sys.stdin = os.fdopen(0)
            from sagemp_cli.reading.process import main

            main()
        finally:
            os._exit(0)

    def poll(self) -> int | None:
        """Its exit code, None while it runs."""
        if self._code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self._code = os.waitstatus_to_exitcode(status) if pid else None
        return self._code

    def wait(self) -> int:
        """Its exit code, when it has ended."""
        if self._code is None:
            self._code = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        return self._code

    def kill(self) -> None:
        """End it."""
        if self._code is None:
            os.kill(self.pid, signal.SIGKILL)


def memory_of(process: int, what: str) -> int:
    """Resident memory of a process in bytes, now (``VmRSS``) or at its peak (``VmHWM``); 0 of one that has ended."""
    try:
        status = Path(f"/proc/{process}/status").read_text()
    except OSError:
        return 0
    return 1024 * int(status.split(f"{what}:")[1].split()[0]) if f"{what}:" in status else 0
