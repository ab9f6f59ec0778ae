"""Cells of other people's loops: those that ``partitions="auto"`` finds against even grids of about as many.

``python benchmarks/cells.py --networks FOLDER [--only NAME ...] [--late]``, the folder with the ONNX files of ARCH-COMP
AINNCS (``docs/arch_comp.md`` says where they are). Each loop is stepped by forward Euler, some steps a period. Widths
are the geometric mean over steps and states, relative to one cell; times are processor time. With ``--late`` a set is
halved in the middle of the horizon instead, along the generator that pays most, and what that narrows the steps after
it by is compared with what the best halving of the start box does.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples" / "arch_comp"))

from acc import Acc  # noqa: E402
from double_pendulum import LessRobust, MoreRobust  # noqa: E402
from nav import Nav  # noqa: E402
from tora import Tora  # noqa: E402
from unicycle import Unicycle  # noqa: E402

from sagemp_cli.loop.onnx_format.lowering import read_network  # noqa: E402
from sagemp_cli.reachability.affine.affine import Affine  # noqa: E402
from sagemp_cli.reachability.any_loop import cells_of, counts_of  # noqa: E402
from sagemp_cli.reachability.foreseeing import reach_foreseeing  # noqa: E402
from sagemp_cli.reachability.narrowing import narrowing_cells  # noqa: E402
from sagemp_cli.reachability.observed import Observed, observed  # noqa: E402
from sagemp_cli.sets import Box, Tube  # noqa: E402
from sagemp_cli.sets.partition import halved  # noqa: E402
from sagemp_cli.sets.zonotope import Zonotope  # noqa: E402

LOOPS = {
    "TORA": (Tora, 10, 20),
    "NAV": (Nav, 2, 30),
    "Unicycle": (Unicycle, 4, 50),
    "ACC": (Acc, 1, 50),
    "less robust": (LessRobust, 1, 8),
    "more robust": (MoreRobust, 1, 20),
}
"""The class, Euler steps a period, and periods."""


def loop_of(name: str, networks: Path) -> Observed:
    """A loop, its period as one step."""
    kind, parts, horizon = LOOPS[name]
    plant, network = kind(), read_network(networks / kind.network)
    length = plant.period / parts

    def step(x: Tensor, w: Tensor) -> Tensor:
        u = plant.control(x, network)
        for _ in range(parts):
            x = x + length * plant.rate(x, u)
        return x + w

    lower, upper = zip(*plant.start, strict=True)
    sides = zip(*getattr(plant, "disturbance", ((0.0, 0.0),) * len(lower)), strict=True)
    w = Box(*([plant.period * v for v in side] for side in sides))
    return observed(step, Box(lower, upper), w, horizon)


def width(tube: Tube) -> float:
    """Geometric mean."""
    sides = tube.hull().width[1:].clamp(1e-300, 1e300)
    return math.exp(float(sides.log().mean()))


def measure(name: str, networks: Path) -> None:
    """One loop."""
    seen, affine = loop_of(name, networks), Affine()

    def grid(partitions: int | list[int]) -> tuple[float, Tube]:
        began = time.process_time()
        tube = affine.propagate(
            seen.loop, cells_of(seen.start, counts_of(partitions, seen.start) or []), seen.disturbance
        )
        return time.process_time() - began, tube

    grid(1)
    began = time.process_time()

    def bounded(cells: Box):
        found = reach_foreseeing(affine, seen.loop, cells, seen.disturbance)
        assert found.halves is not None
        return found.tube, found.halves

    with torch.no_grad():
        auto = narrowing_cells(bounded, seen.start)
    spent = time.process_time() - began
    (once, one), count = grid(1), len(auto.lower)
    rows = [("one cell", 1, once, one), ("auto", count, spent, auto)]
    rows += [(f"even grid of {n}", n, *grid(n)) for n in sorted({count, 64})]
    for what, cells, seconds, tube in rows:
        print(f"{name:12} {what:16} {cells:3} cells  width {width(tube) / width(one):.3f}  {seconds:.2f} s", flush=True)


def late(name: str, networks: Path, tried: int = 10) -> None:
    """The same, of halving a set later, along one of its largest generators."""
    seen, affine = loop_of(name, networks), Affine()
    loop, w, whole = seen.loop, seen.disturbance, cells_of(seen.start, [])
    uncertain = [i for i in range(whole.dim) if whole.width[0, i] > 0]
    started = [affine.propagate(loop, halved(whole, torch.tensor([i])), w).hull() for i in uncertain]
    one = affine.propagate(loop, whole, w)
    for k in (loop.horizon // 5, loop.horizon // 2):
        before = affine.run(loop, whole, w, horizon=k)
        assert before.last is not None
        rest = dataclasses.replace(loop, numbers=loop.numbers[k:], horizon=loop.horizon - k)
        center, generators = before.last.center[0], before.last.generators[0]
        size = np.abs(generators) / np.abs(generators).sum(1, keepdims=True)
        largest = np.argsort(-size.max(0))[:tried]
        halves = [(center + sign * 0.5 * generators[:, j], j) for j in largest for sign in (-1, 1)]
        cut = np.stack([np.where(np.arange(size.shape[1]) == j, 0.5, 1.0) * generators for _, j in halves])
        box = before.tube.lower[:, -1], before.tube.upper[:, -1]
        sets = Zonotope(np.stack([c for c, _ in halves]), cut)
        low, high = torch.from_numpy(sets.low).maximum(box[0]), torch.from_numpy(sets.high).minimum(box[1])
        tubes = affine.run(rest, Box(low, high), w, states=sets).tube
        pairs = (Tube(tubes.lower[2 * i : 2 * i + 2], tubes.upper[2 * i : 2 * i + 2]) for i in range(len(largest)))
        later = Tube(one.lower[:, k:], one.upper[:, k:])
        found = [width(pair) / width(later) for pair in pairs]
        early = min(width(Tube(t.lower[None, k:], t.upper[None, k:])) for t in started) / width(later)
        born = "at the start" if largest[int(np.argmin(found))] < whole.dim else "later"
        print(f"{name:12} steps {k} to {loop.horizon}: halved at step {k} {min(found):.3f} (a generator born {born}), "
              f"at the start {early:.3f}", flush=True)  # fmt: skip


def main() -> None:
    """Measure what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--networks", type=Path, required=True)
    parser.add_argument("--only", nargs="+", default=list(LOOPS), choices=list(LOOPS))
    parser.add_argument("--late", action="store_true", help="halve sets in the middle of the horizon")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    for name in options.only:
        (late if options.late else measure)(name, options.networks)


if __name__ == "__main__":
    main()
