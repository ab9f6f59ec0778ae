"""The times of two checkouts, measured in turns: ``python benchmarks/against.py OTHER [--rounds N] [--only ROW]``.

Each checkout runs the rows of its own ``benchmarks/reachability.py`` in a process of its own, on the cases of this
one's cache; the two take turns, row by row, so that a machine whose speed drifts drifts for both. Printed is the least
time of each figure in either, and the ratio. What is no time is left out, and with it what takes long and is no time:
the inner estimates and auto_LiRPA.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent.parent
LEFT_OUT = ("unicycle against auto_LiRPA", "rigorous against plain float")
"""Rows whose figures are ratios within one checkout."""


def serve(checkout: Path) -> None:
    """Answer names of rows with their times, line by line."""
    sys.path[:1] = [str(checkout / "benchmarks"), str(checkout)]
    import cases
    import numpy as np
    import reachability
    import torch

    torch.set_num_threads(1)
    reachability.FOLDER = HERE / reachability.FOLDER
    reachability.against_inner = lambda *_, **__: float("nan")
    reachability.learned_unicycle = functools.cache(reachability.learned_unicycle)
    cases._cached = lambda path, digest: dict(np.load(path)) if path.is_file() else None  # the same for both
    print(json.dumps([name for name in reachability.ROWS if name not in LEFT_OUT]), flush=True)
    for name in map(str.strip, sys.stdin):
        figures = reachability.ROWS[name](True)
        print(json.dumps({f.what: (f.reached, f.unit) for f in figures if f.unit in ("s", "1/s")}), flush=True)


def started(checkout: Path) -> subprocess.Popen[str]:
    """A process that serves a checkout's rows."""
    command = [sys.executable, str(Path(__file__).resolve()), str(checkout), "--serve"]
    environment = os.environ | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        command, cwd=checkout, env=environment, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )


def said(process: subprocess.Popen[str]) -> Any:
    """What a process answers."""
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        sys.exit("a checkout's process has ended; its error is above")
    return json.loads(line)


def seconds(value: float, unit: str) -> float:
    """A time, of a time or of a rate."""
    return 1 / value if unit == "1/s" else value


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Times of two checkouts, in turns.")
    parser.add_argument("other", type=Path, help="the checkout to compare with")
    parser.add_argument("--rounds", type=int, default=4, help="turns of each")
    parser.add_argument("--only", metavar="ROW", action="append", help="rows whose name contains this")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve(options.other.resolve())
        return
    checkouts = [started(path.resolve()) for path in (options.other, HERE)]
    rows = [said(process) for process in checkouts]
    print("| case | figure | before, s | after, s | after / before |\n|---|---|---|---|---|")
    for name in (name for name in rows[0] if name in rows[1]):
        if options.only and not any(part in name for part in options.only):
            continue
        least: list[dict[str, float]] = [{}, {}]
        for _ in range(options.rounds):
            for times, process in zip(least, checkouts, strict=True):
                assert process.stdin is not None
                print(name, file=process.stdin, flush=True)
                for what, (value, unit) in said(process).items():
                    times[what] = min(times.get(what, float("inf")), seconds(value, unit))
        before, after = least
        for what in before.keys() & after.keys():
            ratio = after[what] / before[what]
            print(f"| {name} | {what} | {before[what]:.3g} | {after[what]:.3g} | {ratio:.3f} |", flush=True)


if __name__ == "__main__":
    main()
