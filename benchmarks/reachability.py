"""Every figure that the reachability core is measured by, in one run; ratios compare what was measured side by side.

``python benchmarks/reachability.py [--quick] [--only ROW] [--list]`` prints a table; without options it also writes
``artifacts/benchmarks/reachability.json``. The first run builds the cases (references by trajectory optimisation,
trackers by training: some minutes). Each row runs in a process of its own with one thread, so that its peak memory is
its own. Times are processor time, the least of several runs.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import multiprocessing
import os
import platform
import resource
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parent))

import cases  # noqa: E402
import plain_affine  # noqa: E402
from inner import inner_estimate  # noqa: E402
from learned import learned_unicycle  # noqa: E402
from swarm import Swarm  # noqa: E402

from sagemp_cli.loop.closed_loop import ClosedLoop  # noqa: E402
from sagemp_cli.problem import Problem  # noqa: E402
from sagemp_cli.reachability import reach  # noqa: E402
from sagemp_cli.reachability.affine.affine import Affine  # noqa: E402
from sagemp_cli.reachability.crown.best import Best  # noqa: E402
from sagemp_cli.reachability.lirpa.auto_lirpa import AutoLirpa  # noqa: E402
from sagemp_cli.reachability.program.loops import RecordedLoop, recorded  # noqa: E402
from sagemp_cli.reachability.propagator import Loop, Propagator  # noqa: E402
from sagemp_cli.sets import Box, Tube  # noqa: E402
from sagemp_cli.sets.partition import parse_partitions, partition, uncertain_dimensions  # noqa: E402
from sagemp_cli.verification.cells import CellProver, Chunk  # noqa: E402

FOLDER = Path("artifacts") / "benchmarks"
MEMORY = 2.0
"""GiB that no row may exceed."""


@dataclass(frozen=True)
class Figure:
    """One number of a row.

    Attributes:
        what: in words.
        reached: the number.
        unit: of it.
        asked: the bound, None for what is only told.
        least: whether the bound is a lower one.
        note: how it was measured, where that is not obvious.
    """

    what: str
    reached: float
    unit: str = ""
    asked: float | None = None
    least: bool = False
    note: str = ""

    @property
    def met(self) -> bool | None:
        """Whether the bound is kept."""
        if self.asked is None:
            return None
        return self.reached >= self.asked if self.least else self.reached <= self.asked


Row = Callable[[bool], list[Figure]]
ROWS: dict[str, Row] = {}


def row(name: str) -> Callable[[Row], Row]:
    """Register a row under a name."""

    def register(function: Row) -> Row:
        ROWS[name] = function
        return function

    return register


def timed(function: Callable[[], Any], repeats: int = 3) -> tuple[float, Any]:
    """The least processor time in seconds, and the result."""
    best, result = float("inf"), None
    for _ in range(repeats):
        began = time.process_time()
        result = function()
        best = min(best, time.process_time() - began)
    return best, result


def cells_of(case: cases.Case, count: int) -> Box:
    """The start box in that many cells."""
    counts = parse_partitions(count, len(uncertain_dimensions(case.start)))
    return partition(case.start, counts)


def ratio(widths: Tensor, reference: Tensor) -> float:
    """Mean over steps 1..K and coordinates of the ratio of two widths ``(K+1, n)``."""
    return float((widths[1:] / reference[1:])[reference[1:] > 0].mean())


def against_inner(tube: Tube, loop: Loop, start: Box, disturbance: Box, *, every: int) -> float:
    """Mean over every so many steps, and coordinates, of the tube's width over that of the inner estimate."""
    steps = list(range(every, loop.horizon + 1, every))
    estimate = inner_estimate(
        loop, start, disturbance, generator=torch.Generator().manual_seed(0), steps=steps, restarts=1
    )
    return float(estimate.ratio(tube)[steps].nanmean())


def prefix(loop: ClosedLoop, start: Box, disturbance: Box, steps: int) -> RecordedLoop:
    """The first steps of a loop."""
    whole = recorded(loop, start, disturbance)
    return dataclasses.replace(whole, numbers=whole.numbers[:steps], horizon=steps)


@row("unicycle against auto_LiRPA")
def unicycle_against_auto_lirpa(quick: bool) -> list[Figure]:
    case = cases.load("unicycle", FOLDER)
    loop = prefix(case.loop(), case.start, case.disturbance, 20 if quick else case.loop().horizon)

    def run(propagator: Propagator, repeats: int) -> tuple[float, Tube]:
        return timed(lambda: propagator.propagate(loop, case.start, case.disturbance), repeats)

    t_affine, affine = run(Affine(), 5)
    t_best, best = run(Best(), 3)
    t_lirpa, lirpa = run(AutoLirpa(), 1)
    note = f"K = {loop.horizon}; auto_LiRPA {t_lirpa:.1f} s, affine {t_affine:.3f} s, best {t_best:.3f} s"
    return [
        Figure("affine: times faster", t_lirpa / t_affine, "x", None if quick else 3000, True, note),
        Figure("best: times faster", t_lirpa / t_best, "x", None if quick else 500, True, note),
        Figure("affine: width over auto_LiRPA's", ratio(affine.width, lirpa.width), "x", 1.0),
        Figure("best: width over auto_LiRPA's", ratio(best.width, lirpa.width), "x", 1.0),
        Figure("auto_LiRPA: time", t_lirpa, "s", note="graph and bounds, one-shot CROWN"),
    ]


@row("unicycle against the inner estimate")
def unicycle_tightness(quick: bool) -> list[Figure]:
    case = cases.load("unicycle", FOLDER)
    figures = []
    for name, propagator, asked in (("affine", Affine(), 1.10), ("best", Best(), 1.05)):
        seconds, tube = timed(lambda p=propagator: p.propagate(case.loop(), case.start, case.disturbance))
        width = against_inner(tube, case.loop(), case.start, case.disturbance, every=10 if quick else 4)
        figures += [
            Figure(f"{name}: width over the inner estimate", width, "x", asked),
            Figure(f"{name}: time", seconds, "s"),
        ]
    return figures


@row("a chunk of one cell, as a verification proves it")
def one_cell(quick: bool) -> list[Figure]:
    figures = []
    for name in ("unicycle", "planar_quadrotor", "quadrotor"):
        case = cases.load(name, FOLDER)
        problem = Problem(case.dynamics, case.scene, case.start, case.disturbance, case.loop().horizon)
        cell = Box(case.start.lower[None], case.start.upper[None])
        chunk = Chunk(0, torch.zeros(1, dtype=torch.int64), case.references[:1], cell)
        prover = CellProver(Affine(), problem, case.tracker)
        seconds, _ = timed(lambda p=prover, c=chunk: p.prove(c), 5)
        figures.append(Figure(f"affine, {name}: time", seconds, "s", note="the step is recorded at the first chunk"))
    return figures


@row("loops of one's own")
def own_loops(quick: bool) -> list[Figure]:
    case = cases.load("unicycle", FOLDER)
    loop, start, w = case.loop(), case.start, case.disturbance
    steps = {"steps alike": lambda k, x, w: loop.step(0, x, w), "steps with references": loop.step}
    function, _ = timed(lambda: reach(lambda x, w: loop.step(0, x, w), start, w, loop.horizon))
    figures = [Figure("reach of a function: time", function, "s")]
    for what, step in steps.items():
        seconds, _ = timed(lambda s=step: reach(s, start, w, loop.horizon))
        figures.append(Figure(f"step(k, x, w), {what}: time over the function's", seconds / function, "x", 2.0))
    return figures


def _four_cells(name: str, asked_seconds: float, asked_width: float, quick: bool) -> list[Figure]:
    case = cases.load(name, FOLDER)
    cells = cells_of(case, 4)
    seconds, tube = timed(lambda: Affine().propagate(case.loop(), cells, case.disturbance), 5)
    width = against_inner(tube.hull(), case.loop(), case.start, case.disturbance, every=20 if quick else 10)
    return [
        Figure("affine, 4 cells: time", seconds, "s", asked_seconds),
        Figure("affine, 4 cells: width over the inner estimate", width, "x", asked_width),
    ]


@row("planar quadrotor")
def planar_quadrotor(quick: bool) -> list[Figure]:
    return _four_cells("planar_quadrotor", 0.2, 1.15, quick)


@row("3-D quadrotor")
def quadrotor(quick: bool) -> list[Figure]:
    return _four_cells("quadrotor", 0.5, 1.12, quick)


@row("six coupled quadrotors")
def swarm(quick: bool) -> list[Figure]:
    case = cases.load("quadrotor", FOLDER)
    angle = torch.arange(6, dtype=torch.float64) * (torch.pi / 3)
    offsets = torch.stack([torch.cos(angle), torch.sin(angle), torch.zeros(6, dtype=torch.float64)], dim=-1)
    loop = Swarm.of(case.dynamics, case.tracker, case.references[0], offsets=offsets, stiffness=0.25)
    center = (case.start.center.expand(6, -1) + torch.nn.functional.pad(offsets, (0, 9))).flatten()
    start = Box.around(center, case.start.radius.repeat(6))
    disturbance = Box.around([0.0] * 72, case.disturbance.upper.repeat(6))
    figures = []
    for symbols in (None, 3600):
        seconds, tube = timed(lambda s=symbols: Affine(symbols=s).propagate(loop, start, disturbance), 1)
        position = torch.tensor([12 * i + j for i in range(6) for j in range(3)])
        label = "all symbols" if symbols is None else f"{symbols} symbols"
        figures += [
            Figure(f"affine, {label}: time", seconds, "s", 5.0),
            Figure(f"affine, {label}: mean width of positions at K", float(tube.width[-1, position].mean()), "m"),
        ]
    return figures


@row("learned dynamics 3 x 64")
def learned(quick: bool) -> list[Figure]:
    case = cases.load("unicycle", FOLDER)
    model, errors = learned_unicycle()
    loop = ClosedLoop(model, case.tracker, case.references[0])
    cells = cells_of(case, 4)
    figures = [Figure("root mean square error of the learned derivative", float((errors.rms**2).mean() ** 0.5))]
    for symbols in (None, 400):
        seconds, tube = timed(lambda s=symbols: Affine(symbols=s).propagate(loop, cells, case.disturbance), 1)
        label = "all symbols" if symbols is None else f"{symbols} symbols"
        width = against_inner(tube.hull(), loop, case.start, case.disturbance, every=20)
        figures += [
            Figure(f"affine, 4 cells, {label}: time", seconds, "s", 3.0, note="network of a short training"),
            Figure(f"affine, 4 cells, {label}: width over the inner estimate", width, "x"),
        ]
    return figures


@row("throughput, planar quadrotor")
def throughput(quick: bool) -> list[Figure]:
    case = cases.load("planar_quadrotor", FOLDER)
    count, symbols, at_once = 32 if quick else 256, 60, 256
    shifts = torch.linspace(-0.2, 0.2, count, dtype=torch.float64)
    references = case.references[torch.arange(count) % len(case.references)].clone()
    references[..., 1] += shifts[:, None]  # the robot is the same anywhere: shifted trajectories are as feasible
    relative = cells_of(case, 4)
    at = references[:, None, 0] - case.references[0, 0]
    cells = Box((relative.lower + at).reshape(-1, 6), (relative.upper + at).reshape(-1, 6))
    owner = torch.arange(count).repeat_interleave(4)

    def run(kept: int | None, some: int) -> Tube:
        parts = []
        for begin in range(0, some, at_once):
            which = slice(begin, min(begin + at_once, some))
            loop = ClosedLoop(case.dynamics, case.tracker, references[owner[which]])
            box = Box(cells.lower[which], cells.upper[which])
            parts.append(Affine(symbols=kept).propagate(loop, box, case.disturbance))
        return Tube(torch.cat([p.lower for p in parts]), torch.cat([p.upper for p in parts]))

    seconds, tube = timed(lambda: run(symbols, len(owner)))
    full = run(None, 16)
    return [
        Figure(
            "cells per second",
            len(owner) / seconds,
            "1/s",
            300,
            True,
            f"{count} references x 4 cells, {symbols} symbols, {at_once} cells at once",
        ),
        Figure("width over that with all symbols", float((tube.width[:16, 1:] / full.width[:, 1:]).nanmean()), "x"),
    ]


def weave(case: cases.Case, steps: int) -> Tensor:
    """A reference of any length for the unicycle: constant speed, a heading that swings."""
    dynamics, start = case.dynamics, case.references[0, 0]
    states = [start]
    for k in range(steps):
        turn = 0.3 * torch.cos(torch.tensor(0.1 * k, dtype=torch.float64))
        u = torch.stack([turn, torch.zeros_like(turn)])
        states.append(dynamics.step(states[-1], u, torch.zeros_like(start)))
    return torch.stack(states)


@row("long horizons, unicycle")
def long_horizons(quick: bool) -> list[Figure]:
    case = cases.load("unicycle", FOLDER)
    symbols, short, long = 60, 200 if quick else 1000, 1000 if quick else 5000
    loops = {steps: ClosedLoop(case.dynamics, case.tracker, weave(case, steps)) for steps in (short, long)}
    start = Box.around(case.references[0, 0], case.start.radius)
    times, tubes = {}, {}
    for steps, loop in loops.items():
        times[steps], tubes[steps] = timed(
            lambda f=loop: Affine(symbols=symbols).propagate(f, start, case.disturbance), 1
        )
    t_full, full = timed(lambda: Affine().propagate(loops[short], start, case.disturbance), 1)
    width = ratio(tubes[short].width, full.width)
    return [
        Figure(
            f"time per step at K = {long} over that at K = {short}",
            (times[long] / long) / (times[short] / short),
            "x",
            1.5,
            note=f"{symbols} symbols: {times[short]:.2f} s and {times[long]:.2f} s",
        ),
        Figure(f"width with {symbols} symbols over that with all, K = {short}", width, "x", 1.3),
        Figure(
            f"width of the last {short} steps of K = {long}, over all of K = {short}",
            float(tubes[long].width[-short:].mean() / tubes[short].width.mean()),
            "x",
            note="that the tube does not grow with the horizon",
        ),
        Figure(f"all symbols, K = {short}: time", t_full, "s"),
    ]


@row("rigorous against plain float")
def rigour(quick: bool) -> list[Figure]:
    return [*_rigour("unicycle"), *_rigour("planar_quadrotor")]


def _rigour(name: str) -> list[Figure]:
    case = cases.load(name, FOLDER)
    loop, cells = case.loop(), cells_of(case, 4)
    rigorous, tube = timed(lambda: Affine().propagate(loop, cells, case.disturbance), 5)
    plain, other = timed(lambda: plain_affine.propagate(loop, cells, case.disturbance), 5)
    excess = (tube.width - other.width)[..., 1:, :] / other.width[..., 1:, :]
    return [
        Figure(
            f"{name}: times slower than plain float",
            rigorous / plain,
            "x",
            2.0,
            note="plain: the same compiled step, sums and bands (with their margins) without bookkeeping of rounding",
        ),
        Figure(f"{name}: what rounding adds to the width", float(excess[excess.isfinite()].max()), note="relative"),
    ]


def _run(name: str, quick: bool, answer: Any) -> None:
    """One row, in a process of its own."""
    torch.set_num_threads(1)
    began = time.perf_counter()
    try:
        figures = ROWS[name](quick)
    except Exception:  # a row that fails is reported; the others go on
        answer.send({"error": traceback.format_exc(limit=-3)})
        return
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    figures.append(Figure("peak memory", memory, "GiB", MEMORY, note="of the whole process, libraries included"))
    answer.send(
        {
            "seconds": time.perf_counter() - began,
            "figures": [dataclasses.asdict(f) | {"met": f.met} for f in figures],
        }
    )


def measure(name: str, quick: bool) -> dict[str, Any]:
    """A row's figures, or the error that it ended in."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_run, args=(name, quick, there))
    process.start()
    there.close()
    try:
        return here.recv()
    except EOFError:
        return {"error": "the process died (out of memory?)"}
    finally:
        process.join()


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    processor = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [line.partition(":")[2].strip() for line in info.read_text().splitlines() if "model name" in line]
        processor = names[0] if names else processor
    return {
        "processor": processor,
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "torch": torch.__version__,
        "threads per process": 1,
    }


def show(found: dict[str, Any]) -> None:
    """The table."""
    from rich.console import Console
    from rich.table import Table

    table = Table("case", "figure", "asked", "reached", "", title="reachability")
    for name, result in found["rows"].items():
        if "error" in result:
            table.add_row(name, "failed", "", "", "[red]error[/]")
            continue
        for i, f in enumerate(result["figures"]):
            asked = "" if f["asked"] is None else f"{'>=' if f['least'] else '<='} {f['asked']:g} {f['unit']}"
            mark = {True: "[green]yes[/]", False: "[red]no[/]", None: ""}[f["met"]]
            table.add_row(name if i == 0 else "", f["what"], asked, f"{f['reached']:.4g} {f['unit']}", mark)
        table.add_section()
    console = Console(width=None if sys.stdout.isatty() else 140)
    console.print(table)
    about = found["machine"]
    console.print(
        f"{about['processor']}, {about['cores']} cores, load {about['load']:.1f}; Python {about['python']}, "
        f"torch {about['torch']}, one thread a process",
        style="dim",
    )
    for name, result in found["rows"].items():
        if "error" in result:
            console.print(f"{name}: {result['error']}", markup=False)


def main() -> int:
    """Measure, print, write; 1 if a row ended in an error."""
    parser = argparse.ArgumentParser(description="Measure the reachability core.")
    parser.add_argument("--quick", action="store_true", help="shorter horizons where a row takes minutes")
    parser.add_argument("--only", metavar="ROW", action="append", help="rows whose name contains this")
    parser.add_argument("--list", action="store_true", help="list the rows")
    options = parser.parse_args()
    if options.list:
        print("\n".join(ROWS))
        return 0
    chosen = [name for name in ROWS if not options.only or any(part in name for part in options.only)]
    if not chosen:
        parser.error(f"no row contains {options.only}; rows: {', '.join(ROWS)}")
    torch.set_num_threads(1)
    for name in cases.RECIPES:
        cases.load(name, FOLDER, progress=cases.Lines())
    found: dict[str, Any] = {"machine": machine(), "quick": options.quick, "rows": {}}
    for name in chosen:
        print(f"{name} ...", file=sys.stderr, flush=True)
        found["rows"][name] = measure(name, options.quick)
    show(found)
    if not options.only and not options.quick:  # what the file holds was measured in one run
        path = FOLDER / "reachability.json"
        path.write_text(json.dumps(found, indent=2) + "\n")
        print(path)
    return 1 if any("error" in result for result in found["rows"].values()) else 0


if __name__ == "__main__":
    sys.exit(main())
