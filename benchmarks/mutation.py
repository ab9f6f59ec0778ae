"""Mutants of the core: small mistakes in the sources, each of which some test has to notice.

A mutant is one change: a rounding that is left out, a comparison that is strict or not, an index one too far, a sign,
the larger for the smaller. The core is copied, one mutant at a time is written into the copy, and the tests that
belong to its module run there until the first one fails. Every outcome is a line of a log, so that a run that was
stopped goes on.

    python benchmarks/mutation.py --sample 300            # 300 mutants, chosen by --seed
    python benchmarks/mutation.py --only checker --sample 50
    python benchmarks/mutation.py --report                # what the log says: rate, survivors
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "sagemp_cli"
CORE = ("sets", "loop", "reachability", "verification", "checker", "execution", "trackers/tube_loss.py")
COPIED = (PACKAGE, "tests", "conf", "data", "template", "docs", "benchmarks", "README.md", "pyproject.toml")

TESTS = {
    "sets": ("tests/sets", "tests/verification/test_verdict.py", "tests/reachability/test_native_propagators.py"),
    "loop": ("tests/loop", "tests/trackers/test_tracker.py", "tests/reachability/test_native_propagators.py"),
    "reachability/relaxations": ("tests/reachability/relaxations", "tests/reachability/test_native_propagators.py"),
    "reachability/affine": (
        "tests/reachability/test_rounding.py",
        "tests/reachability/affine",
        "tests/reachability/test_native_propagators.py",
    ),
    "reachability/crown": ("tests/reachability/crown", "tests/reachability/test_native_propagators.py"),
    "reachability/interval": ("tests/reachability/interval", "tests/reachability/test_native_propagators.py"),
    "reachability/lirpa": ("tests/reachability/lirpa",),
    "reachability/program": ("tests/reachability/program", "tests/reachability/test_in_place.py", "tests/reachability"),
    "reachability": ("tests/reachability/test_rounding.py", "tests/reachability"),
    "verification": ("tests/verification", "tests/execution", "tests/checker/test_adaptive_cells.py"),
    "checker": ("tests/checker",),
    "execution": ("tests/execution", "tests/stages/test_safety_rates.py"),
    "trackers": ("tests/trackers/test_tube_loss.py",),
}
"""Tests of the modules below a path; the longest path counts. What mirrors the module comes first: it fails soonest."""

SWAPPED_NAMES = {
    "minimum": "maximum",
    "maximum": "minimum",
    "amin": "amax",
    "amax": "amin",
    "min": "max",
    "max": "min",
    "all": "any",
    "any": "all",
    "round_up": "round_down",
    "round_down": "round_up",
}
DROPPED_NAMES = {"UNIT": "0.0", "TINY": "0.0", "SAFETY": "1.0"}
COMPARED = {ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">", ast.Eq: "!=", ast.NotEq: "=="}
TOLERANCE = 3.0
"""A mutant may take so many times as long as the tests take without one, and half a minute; then it is noticed too."""


@dataclass(frozen=True)
class Mutant:
    """One change of one file.

    Attributes:
        file: relative to the root.
        line: first line of what is changed, from 1.
        kind: ``rounding``, ``comparison``, ``index``, ``sign`` or ``choice``.
        begin, end: what is replaced, as offsets into the text.
        new: what it is replaced by.
        text: the line before.
    """

    file: str
    line: int
    kind: str
    begin: int
    end: int
    new: str
    text: str

    @property
    def key(self) -> str:
        """What names the mutant as long as its line stays as it is, wherever it moves."""
        return hashlib.sha256(f"{self.file}|{self.kind}|{self.text}|{self.new}".encode()).hexdigest()[:16]

    def applied(self, source: str) -> str:
        """The file's text with the change."""
        return source[: self.begin] + self.new + source[self.end :]


def mutants_of(path: Path, file: str) -> Iterator[Mutant]:
    """All mutants of a module."""
    source = path.read_text(encoding="utf-8")
    lines = source.splitlines(keepends=True)
    starts = [0]
    for line in lines:
        starts.append(starts[-1] + len(line))

    def offset(line: int, column: int) -> int:
        return starts[line - 1] + len(lines[line - 1].encode()[:column].decode())

    for node, kind, new in _changes(ast.parse(source)):
        begin, end = offset(node.lineno, node.col_offset), offset(node.end_lineno, node.end_col_offset)
        around = lines[node.lineno - 1].strip() + f" @{node.col_offset}"
        yield Mutant(file, node.lineno, kind, begin, end, new, around)


def _changes(tree: ast.AST) -> Iterator[tuple[ast.expr, str, str]]:
    """Expressions, what kind of mistake, and what is written instead."""
    for node in _computing(tree):
        match node:
            case ast.Name(id=name) if name in DROPPED_NAMES and isinstance(node.ctx, ast.Load):
                yield node, "rounding", DROPPED_NAMES[name]
            case ast.Call(func=ast.Name(id="round_up" | "round_down"), args=[inner]):
                yield node, "rounding", f"({ast.unparse(inner)})"
                yield node.func, "rounding", SWAPPED_NAMES[node.func.id]
            case ast.Call(func=ast.Name(id=name)) if name in SWAPPED_NAMES:
                yield node.func, "choice", SWAPPED_NAMES[name]
            case ast.Call(func=ast.Attribute(attr=name) as called) if name in SWAPPED_NAMES:
                yield called, "choice", f"{_wrapped(called.value)}.{SWAPPED_NAMES[name]}"
            case ast.Compare(ops=[op], left=left, comparators=[right]) if type(op) in COMPARED:
                yield node, "comparison", f"({_wrapped(left)} {COMPARED[type(op)]} {_wrapped(right)})"
            case ast.BinOp(op=ast.Add() | ast.Sub() as op, left=left, right=right):
                if _is_text(left) or _is_text(right):
                    continue
                other = "-" if isinstance(op, ast.Add) else "+"
                yield node, "sign", f"({_wrapped(left)} {other} {_wrapped(right)})"
                if isinstance(right, ast.Constant) and right.value == 1:
                    yield right, "index", "2" if isinstance(op, ast.Add) else "0"
            case ast.UnaryOp(op=ast.USub(), operand=operand) if not isinstance(operand, ast.Constant):
                yield node, "sign", _wrapped(operand)
            case ast.Subscript(slice=slice_):
                for index in _indices(slice_):
                    yield index, "index", str(_number(index) + 1 if _number(index) >= 0 else _number(index) - 1)
            case _:
                pass


def _computing(node: ast.AST) -> Iterator[ast.AST]:
    """Nodes that compute, outermost first: no annotations, decorators, texts, complaints or documentation."""
    skipped = (ast.Raise, ast.Assert, ast.JoinedStr, ast.Import, ast.ImportFrom)
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "bases"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and not isinstance(child, skipped):
                yield child
                yield from _computing(child)


def _indices(node: ast.expr) -> Iterator[ast.expr]:
    """Whole numbers in an index."""
    parts = [node.lower, node.upper] if isinstance(node, ast.Slice) else [node]
    for part in parts:
        if isinstance(part, ast.Tuple):
            for element in part.elts:
                yield from _indices(element)
        elif part is not None and _number(part) is not None:
            yield part


def _number(node: ast.expr) -> int | None:
    try:
        value = ast.literal_eval(node)
    except (ValueError, TypeError):
        return None
    return value if type(value) is int else None


def _is_text(node: ast.expr) -> bool:
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))


def _wrapped(node: ast.expr) -> str:
    return f"({ast.unparse(node)})"


def all_mutants(only: str = "") -> list[Mutant]:
    """Those of the core, in the order of files and lines; of equal ones in equal lines the first."""
    found: dict[str, Mutant] = {}
    for part in CORE:
        path = ROOT / PACKAGE / part
        for module in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            file = module.relative_to(ROOT).as_posix()
            if only in file:
                for mutant in mutants_of(module, file):
                    found.setdefault(mutant.key, mutant)
    return list(found.values())


def tests_of(file: str) -> tuple[str, ...]:
    """The tests that have to notice: those of the longest path that the module lies below, its own first."""
    inside = file.removeprefix(f"{PACKAGE}/")
    best = max((p for p in TESTS if inside.startswith(p)), key=len)
    mirror = f"tests/{Path(inside).parent}/test_{Path(inside).stem}.py"
    own = [mirror] if (ROOT / mirror).exists() else []
    return tuple(dict.fromkeys([*own, *(t for t in TESTS[best] if (ROOT / t).exists())]))


class Bench:
    """A copy of the project in which mutants run.

    Attributes:
        folder: of the copy.
        seconds: how long the tests of a module take without a mutant, by their names.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.seconds = folder, {}
        for name in COPIED:
            source = ROOT / name
            if source.is_dir():
                shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(source, folder / name)

    def outcome(self, mutant: Mutant) -> dict[str, object]:
        """Whether the tests notice a mutant, and how long that took."""
        tests, path = tests_of(mutant.file), self.folder / mutant.file
        usual = self._usual(tests)
        source = path.read_text(encoding="utf-8")
        path.write_text(mutant.applied(source), encoding="utf-8")
        began = time.monotonic()
        try:
            failed, said = self._run(tests, TOLERANCE * usual + 30.0)
        finally:
            path.write_text(source, encoding="utf-8")
        result = "survived" if not failed else "timeout" if failed == "timeout" else "killed"
        return {"result": result, "by": said, "seconds": round(time.monotonic() - began, 1)}

    def _usual(self, tests: tuple[str, ...]) -> float:
        if tests not in self.seconds:
            began = time.monotonic()
            failed, said = self._run(tests, 3600.0)
            if failed:
                raise SystemExit(f"{' '.join(tests)} fail without any mutant: {said}")
            self.seconds[tests] = time.monotonic() - began
        return self.seconds[tests]

    def _run(self, tests: tuple[str, ...], limit: float) -> tuple[str, str]:
        """``""``, ``"failed"`` or ``"timeout"``, and the first test that failed."""
        command = [sys.executable, "-B", "-m", "pytest", "-x", "-q", "--no-header", "-p", "no:cacheprovider", *tests]
        environment = os.environ | {"PYTHONPATH": str(self.folder), "OMP_NUM_THREADS": "1"}
        try:
            done = subprocess.run(
                command, cwd=self.folder, env=environment, capture_output=True, text=True, timeout=limit, check=False
            )
        except subprocess.TimeoutExpired:
            return "timeout", ""
        if done.returncode == 0:
            return "", ""
        first = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
        return "failed", (first[0] if first else f"exit code {done.returncode}")[:200]


def read_log(path: Path) -> dict[str, dict]:
    """Finished mutants by key."""
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
        lines.append(f"survived: {e['file']}:{e['line']} {e['kind']}: {e['text']}  ->  {e['new']}")
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
    parser.add_argument("--list", action="store_true", help="list the chosen mutants, run nothing")
    parser.add_argument("--report", action="store_true", help="say what the log says, run nothing")
    options = parser.parse_args()
    if options.report:
        print("\n".join(report(read_log(options.log))))
        return
    chosen = all_mutants(options.only)
    if options.sample:
        chosen = random.Random(options.seed).sample(chosen, min(options.sample, len(chosen)))
    if options.list:
        print("\n".join(f"{m.file}:{m.line} {m.kind}: {m.text}  ->  {m.new}" for m in chosen))
        print(f"{len(chosen)} mutants")
        return
    known = read_log(options.log)
    with tempfile.TemporaryDirectory(prefix="sagemp-mutation-") as folder:
        bench = Bench(Path(folder))
        for number, mutant in enumerate(chosen, start=1):
            if mutant.key in known:
                continue
            known[mutant.key] = {"key": mutant.key, **asdict(mutant), **bench.outcome(mutant)}
            with options.log.open("a", encoding="utf-8") as log:
                log.write(json.dumps(known[mutant.key]) + "\n")
            told = known[mutant.key]
            where = f"{mutant.file}:{mutant.line} {mutant.kind}"
            print(f"{number}/{len(chosen)} {told['result']} in {told['seconds']} s: {where}", flush=True)
    print("\n".join(report({m.key: known[m.key] for m in chosen})))


if __name__ == "__main__":
    main()
