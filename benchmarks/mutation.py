"""Mutants of the core: small mistakes in the sources, each of which some test has to notice.

The core is copied, one mutant at a time is written into the copy, and the tests that call the changed function run
there until the first one fails. Which tests those are, and how long they take, is measured once, test file by test
file. Every run is a process forked from one that has imported torch and the other libraries, but nothing of the
project. Outcomes are lines of a log, so that a run that was stopped goes on.

    python benchmarks/mutation.py --sample 300            # 300 mutants, chosen by --seed
    python benchmarks/mutation.py --only checker --sample 50
    python benchmarks/mutation.py --again --only angle --tests tests/checker/test_step.py   # survivors, against these
    python benchmarks/mutation.py --report                # what the log says: rate, survivors
"""

from __future__ import annotations

import argparse
import ast
import compileall
import contextlib
import importlib
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import hypothesis
import pytest
from source_mutants import Mutant, mutants_of

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "sagemp_cli"
CORE = (
    "sets",
    "dynamics",
    "loop",
    "reachability",
    "verification",
    "checker",
    "execution",
    "trackers/losses.py",
    "trackers/tube_loss.py",
)
LEFT_OUT = ("reachability/lirpa",)
"""The adapter of another package, which is an extra."""
COPIED = (PACKAGE, "tests", "conf", "data", "template", "docs", "benchmarks", "README.md", "pyproject.toml")
TESTS = ("sets", "dynamics", "loop", "reachability", "verification", "checker", "execution", "trackers", "pipeline")
"""Folders of tests that may notice; of each mutant those run that call the function it is in."""
SLOW = ("test_processes.py", "test_cluster.py", "test_mutants.py", "test_program_mutants.py")
"""Worker processes and campaigns are not run."""
WARM = """
    torch torch._dynamo torch.utils._python_dispatch numpy scipy.optimize scipy.sparse scipy.special h5py flint mpmath
    onnx pydantic omegaconf hydra rich.console typer anyio sympy matplotlib.figure
    matplotlib.backends.backend_agg
"""
"""Libraries that are imported once, before anything is forked."""

TOLERANCE = 3.0
"""A mutant may take so many times as much processor time as its tests without it, and half a minute more."""
MEMORY = 12 << 30


@dataclass(frozen=True)
class Cost:
    """What a test takes and calls.

    Attributes:
        seconds: of processor time; the first test of a file bears what the file needs.
        called: functions as ``file:line`` of their first line.
    """

    seconds: float
    called: frozenset[str]


class Recorder:
    """A plugin of pytest that notes what each test calls, and the processor time it takes."""

    def __init__(self, folder: Path) -> None:
        self.inside = f"{folder}/"
        self.package = f"{folder}/{PACKAGE}/"
        self.called: set[tuple[str, int]] = set()
        self.shared: set[tuple[str, int]] = set()
        self.costs: dict[str, tuple[float, list[str]]] = {}
        self.began = time.process_time()

    def note(self, frame, event, argument) -> None:
        code = frame.f_code
        if code.co_filename.startswith(self.package):
            self.called.add((code.co_filename, code.co_firstlineno))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self, item):
        # What fixtures call is called for all tests of the file that come later.
        self.called = set()
        sys.settrace(self.note)
        threading.settrace(self.note)
        result = yield
        self.shared |= self.called
        return result

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_teardown(self, item):
        sys.settrace(None)
        threading.settrace(None)
        names = sorted(f"{file.removeprefix(self.inside)}:{line}" for file, line in self.called | self.shared)
        self.costs[item.nodeid] = (time.process_time() - self.began, names)
        self.began = time.process_time()
        return (yield)


class Chosen:
    """A plugin of pytest that runs the named tests in their order (or all, if none is named) until the first fails."""

    def __init__(self, names: Iterable[str]) -> None:
        self.order = {name: i for i, name in enumerate(names)}
        self.failed = ""

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        if not self.order:
            return
        items[:] = sorted((i for i in items if i.nodeid in self.order), key=lambda i: self.order[i.nodeid])

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed and not self.failed:
            self.failed = report.nodeid


class Bench:
    """A copy of the project in which mutants run, and what its tests cost.

    Args:
        folder: where the copy goes.
        costs: log of what the tests cost.
        budget: of the tests that call a function the cheapest run, up to so many seconds of processor time.
        given: files of tests that run instead, all of them, whatever they call.
    """

    def __init__(self, folder: Path, costs: Path, budget: float, given: Sequence[str] = ()) -> None:
        self.folder, self.budget, self.given = folder, budget, given
        for name in COPIED:
            source = ROOT / name
            if source.is_dir():
                shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(source, folder / name)
        compileall.compile_dir(str(folder / PACKAGE), quiet=1)
        for name in WARM.split():
            importlib.import_module(name)
        phases = set(hypothesis.Phase) - {hypothesis.Phase.shrink, hypothesis.Phase.explain}
        hypothesis.settings.register_profile("mutants", phases=phases)
        self.costs = {} if given else self._measured(costs)

    def _measured(self, path: Path) -> dict[str, Cost]:
        """The cost of every test, measured file by file where the log of costs does not have it yet."""
        known = {e["file"]: e["tests"] for e in map(json.loads, path.read_text().splitlines())} if path.exists() else {}
        files = [f for part in TESTS for f in sorted((self.folder / "tests" / part).rglob("test_*.py"))]
        for file in files:
            name = file.relative_to(self.folder).as_posix()
            if file.name in SLOW or name in known:
                continue
            recorder = Recorder(self.folder)

            def work(recorder=recorder, name=name) -> dict:
                recorder.began = time.process_time()
                code = int(pytest.main([*OPTIONS, name], plugins=[recorder]))
                return {"code": code, "tests": recorder.costs}

            told = self._forked(work, limit=600.0)
            if told.get("code") not in (0, 5):
                raise SystemExit(f"{name} fails without any mutant: {str(told)[-2000:]}")
            known[name] = told["tests"]
            with path.open("a", encoding="utf-8") as log:
                log.write(json.dumps({"file": name, "tests": told["tests"]}) + "\n")
            total = sum(seconds for seconds, _ in told["tests"].values())
            print(f"{name}: {len(told['tests'])} tests, {total:.1f} s", flush=True)
        return {n: Cost(s, frozenset(c)) for tests in known.values() for n, (s, c) in tests.items()}

    def tests_of(self, mutant: Mutant) -> list[str]:
        """Tests that call the function of the mutant, or for what is in no function any of its module: those of the
        file that mirrors the module first, then file by file, the cheapest first, as long as the budget allows.
        """
        lines = _function_around(self.folder / mutant.file, mutant.line)
        called = {f"{mutant.file}:{line}" for line in lines}
        if lines:
            names = [name for name, cost in self.costs.items() if cost.called & called]
        else:
            begin = f"{mutant.file}:"
            names = [name for name, cost in self.costs.items() if any(c.startswith(begin) for c in cost.called)]
        files: dict[str, list[str]] = {}
        for name in names:
            files.setdefault(name.split("::")[0], []).append(name)
        mirror = f"test_{Path(mutant.file).stem}.py"

        def order(file: str) -> tuple[bool, float]:
            return not file.endswith(f"/{mirror}"), sum(self.costs[name].seconds for name in files[file])

        chosen: list[str] = []
        left = self.budget
        for file in sorted(files, key=order):
            for name in files[file]:
                if self.costs[name].seconds <= left:
                    left -= self.costs[name].seconds
                    chosen.append(name)
        return chosen

    def outcome(self, mutant: Mutant) -> dict[str, object]:
        """Whether the tests notice a mutant, and how long that took."""
        tests, path = list(self.given) or self.tests_of(mutant), self.folder / mutant.file
        if not tests:
            return {"result": "survived", "by": "no test calls it", "tests": 0, "seconds": 0.0}
        source = path.read_text(encoding="utf-8")
        for stale in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
            stale.unlink()
        path.write_text(mutant.applied(source), encoding="utf-8")
        began = time.monotonic()

        def work() -> dict:
            plugin = Chosen(tests if not self.given else ())
            files = dict.fromkeys(name.split("::")[0] for name in tests)
            code = int(pytest.main(["-x", *OPTIONS, *files], plugins=[plugin]))
            return {"code": code, "failed": plugin.failed}

        usual = sum(self.costs[name].seconds for name in tests) if not self.given else 60.0
        try:
            told = self._forked(work, limit=TOLERANCE * usual + 30.0)
        finally:
            path.write_text(source, encoding="utf-8")
        match told.get("code"):
            case 0:
                result = "survived"
            case 1 | 2 | 3:
                result = "killed"
            case None:
                result = "timeout" if told["signal"] in (signal.SIGXCPU, signal.SIGKILL) else "killed"
            case code:
                raise SystemExit(f"pytest ends with {code}: {told['said'][-2000:]}")
        by = told.get("failed") or (f"signal {told['signal']}" if told.get("code") is None else "it does not import")
        return {
            "result": result,
            "by": "" if result == "survived" else by,
            "tests": len(tests),
            "seconds": round(time.monotonic() - began, 1),
        }

    def _forked(self, work: Callable[[], dict], *, limit: float) -> dict:
        """What a child process says in the end: its dictionary and, under ``said``, what it printed. Without ``code``
        it was stopped by a ``signal``: by its processor time above all, since the machine may be busy.
        """
        with tempfile.TemporaryDirectory(prefix="run-", dir=self.folder) as place:
            output, answer = Path(place, "output"), Path(place, "answer")
            sys.stdout.flush()
            child = os.fork()
            if child == 0:
                try:
                    os.setsid()
                    resource.setrlimit(resource.RLIMIT_CPU, (int(limit) + 1, int(limit) + 5))
                    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
                    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
                    descriptor = os.open(output, os.O_CREAT | os.O_WRONLY)
                    os.dup2(descriptor, 1)
                    os.dup2(descriptor, 2)
                    os.chdir(self.folder)
                    sys.path[:0] = [str(self.folder), str(self.folder / "benchmarks")]
                    os.environ["PYTHONPATH"] = str(self.folder)
                    os.environ["TMPDIR"] = tempfile.tempdir = place
                    told = work()
                    source = sys.modules[PACKAGE].__file__ if PACKAGE in sys.modules else str(self.folder)
                    if not source.startswith(str(self.folder)):
                        told = {"code": 99}
                    answer.write_text(json.dumps(told), encoding="utf-8")
                except BaseException:
                    traceback.print_exc()
                finally:
                    sys.stdout.flush()
                    os._exit(0)
            status, deadline = None, time.monotonic() + 12 * limit + 60
            while status is None:
                done, code = os.waitpid(child, os.WNOHANG)
                if done:
                    status = code
                elif time.monotonic() > deadline:
                    os.killpg(child, signal.SIGKILL)
                    deadline += 60
                else:
                    time.sleep(0.05)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)
            said = output.read_text(encoding="utf-8", errors="replace") if output.exists() else ""
            if not answer.exists():
                return {"signal": os.WTERMSIG(status), "said": said}
            return json.loads(answer.read_text(encoding="utf-8")) | {"said": said}


OPTIONS = (
    "-q",
    "--no-header",
    "-p",
    "no:cacheprovider",
    "-p",
    "no:xdist",
    "--hypothesis-seed=0",
    "--hypothesis-profile=mutants",
    "-W",
    "ignore::pytest.PytestAssertRewriteWarning",
)


def _function_around(path: Path, line: int) -> range:
    """The lines of the outermost function that a line is in, its decorators with it; none outside of functions."""
    for node in _functions(ast.parse(path.read_text(encoding="utf-8"))):
        first = min([node.lineno, *(d.lineno for d in node.decorator_list)])
        if first <= line <= node.end_lineno:
            return range(first, node.end_lineno + 1)
    return range(0)


def _functions(tree: ast.AST) -> Iterable[ast.FunctionDef]:
    """Functions and methods, outermost only."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef):
            yield node
        else:
            yield from _functions(node)


def all_mutants(only: str = "") -> list[Mutant]:
    """Those of the core, in the order of files and lines; of equal ones in equal lines the first."""
    found: dict[str, Mutant] = {}
    for part in CORE:
        path = ROOT / PACKAGE / part
        for module in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            file = module.relative_to(ROOT).as_posix()
            if only in file and not file.startswith(tuple(f"{PACKAGE}/{p}" for p in LEFT_OUT)):
                for mutant in mutants_of(module, file):
                    found.setdefault(mutant.key, mutant)
    return list(found.values())


def read_log(path: Path) -> dict[str, dict]:
    """Finished mutants by key; of one that ran twice the last."""
    if not path.exists():
        return {}
    return {entry["key"]: entry for entry in map(json.loads, path.read_text(encoding="utf-8").splitlines())}


def report(entries: dict[str, dict]) -> list[str]:
    """Rates by kind and module, and who survived."""
    survivors = [e for e in entries.values() if e["result"] == "survived"]
    lines = [f"{len(entries)} mutants, {len(entries) - len(survivors)} noticed ({_rate(entries.values())})"]
    for title, key in (("kind", lambda e: e["kind"]), ("part", lambda e: e["file"].split("/")[1])):
        counts = Counter(map(key, entries.values()))
        lines += [
            f"  {title} {name}: {_rate([e for e in entries.values() if key(e) == name])} of {counts[name]}"
            for name in sorted(counts)
        ]
    for e in sorted(survivors, key=lambda e: (e["file"], e["line"])):
        lines.append(f"survived: {e['file']}:{e['line']} {e['kind']}: {e['text']}  ->  {e['new']}  [{e['by']}]")
    return lines


def _rate(entries) -> str:
    entries = list(entries)
    return f"{100 * sum(e['result'] != 'survived' for e in entries) / max(1, len(entries)):.1f} %"


def main() -> None:
    """Run mutants that are not in the log yet, or say what the log says."""
    parser = argparse.ArgumentParser(description="Mutants of the core, and whether the tests notice them.")
    parser.add_argument("--sample", type=int, default=0, help="how many of all mutants; 0: all")
    parser.add_argument("--seed", type=int, default=0, help="which ones")
    parser.add_argument("--only", default="", help="part of the names of the files, e.g. checker")
    parser.add_argument("--log", type=Path, default=Path("mutation.jsonl"), help="lines of JSON, one a mutant")
    parser.add_argument("--again", action="store_true", help="run the survivors in the log once more, and only them")
    parser.add_argument("--tests", nargs="+", default=[], help="run these files of tests, not those that call")
    parser.add_argument("--budget", type=float, default=40.0, help="seconds of tests a mutant, as measured once")
    parser.add_argument("--list", action="store_true", help="list the chosen mutants, run nothing")
    parser.add_argument("--report", action="store_true", help="say what the log says, run nothing")
    options = parser.parse_args()
    known = read_log(options.log)
    if options.report:
        print("\n".join(report(known)))
        return
    chosen = all_mutants(options.only)
    if options.sample:
        chosen = random.Random(options.seed).sample(chosen, min(options.sample, len(chosen)))
    if options.list:
        print("\n".join(f"{m.file}:{m.line} {m.kind}: {m.text}  ->  {m.new}" for m in chosen))
        print(f"{len(chosen)} mutants")
        return
    if options.again:
        alive = {key for key, entry in known.items() if entry["result"] == "survived"}
        chosen = [m for m in all_mutants(options.only) if m.key in alive]
        known = {}
    with tempfile.TemporaryDirectory(prefix="sagemp-mutation-") as folder:
        bench = Bench(Path(folder).resolve(), options.log.with_suffix(".costs.jsonl"), options.budget, options.tests)
        for number, mutant in enumerate(chosen, start=1):
            if mutant.key in known:
                continue
            known[mutant.key] = {"key": mutant.key, **asdict(mutant), **bench.outcome(mutant)}
            with options.log.open("a", encoding="utf-8") as log:
                log.write(json.dumps(known[mutant.key]) + "\n")
            told = known[mutant.key]
            where = f"{mutant.file}:{mutant.line} {mutant.kind}"
            print(f"{number}/{len(chosen)} {told['result']} in {told['seconds']} s: {where} [{told['by']}]", flush=True)
    print("\n".join(report({m.key: known[m.key] for m in chosen})))


if __name__ == "__main__":
    main()
