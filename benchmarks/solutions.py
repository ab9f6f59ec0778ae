"""Soundness campaign in continuous time: simulated solutions against what certificates say at and between the instants.

    python benchmarks/solutions.py [--rollouts 1000000] [--artifacts artifacts]

Takes every certificate below the artifacts folder that is in continuous time, of robots of ours and of strangers.
Starts are corners and points of its cells; signals of w are vertices of W, held, switched at random, or switched at 1
to 64 times the sample rate, in all states together or in each by itself; of a control that lags delays and jitters are
random and, at every other instant, as small or as large as may be. The file's own programs are integrated by the
classical Runge-Kutta method in 64 parts of a period; compared are the states at the instants with the tube, those
between with the box that the flow does not leave and with the straight lines and their bulges, and the margins of what
is required with those that are certified. A difference of :data:`MARGIN` is granted to the integrator. Ends with exit
code 1 if a single solution ever was outside.
"""

from __future__ import annotations

import argparse
import functools
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.pipeline.tubes import flows_of
from sagemp_cli.reachability.flow import Flow
from sagemp_cli.reachability.program.program import Program
from sagemp_cli.reachability.program.stored import from_record
from sagemp_cli.sets import Box, Tube
from sagemp_cli.storage import Certificate, Library, LoopRecord, Tubes, open_header, read_artifact

FINE = 64
"""Parts of a period that are integrated, and looked at."""
MARGIN = 1e-7
"""Of a state, for what the integrator is off by; halving its step changes states by less than 1e-9 here."""
BATCH = 2000


def signals(w: Box, periods: int, count: int, generator: torch.Generator) -> Tensor:
    """Signals ``(count, periods FINE, n)``, constant on each part."""
    steps, found = periods * FINE, []
    for r in range(count):
        every = 2 ** (r % 13)  # from every part on to 64 periods
        together = r // 13 % 2 == 0
        sides = torch.rand(-(-steps // every), 1 if together else w.dim, generator=generator) < 0.5
        if r % 3 == 0:  # a square wave
            sides = (torch.arange(len(sides)) % 2 == 0)[:, None].expand(-1, sides.shape[-1])
        chosen = torch.where(sides, w.lower, w.upper).repeat_interleave(every, 0)
        shift = int(torch.randint(every, (), generator=generator))
        found.append(chosen.roll(shift, 0)[:steps])
    return torch.stack(found)


@dataclass(frozen=True)
class Escapes:
    """What a comparison found.

    Attributes:
        rollouts: solutions that were compared.
        outside: how many of them left what is certified by more than :data:`MARGIN`.
        worst: by how much one did at most; negative if none did at all.
    """

    rollouts: int
    outside: int
    worst: float


def compared(path: Path, reference: int, rollouts: int, generator: torch.Generator) -> Escapes:
    """Solutions of how a certificate's or a library's reference moves, against what it says of that.

    Args:
        path: the file, in continuous time.
        reference: of those in it.
        rollouts: solutions.
        generator: draws starts and signals.
    """
    kind, _ = open_header(path)
    record = read_artifact(path, Certificate if kind.name == "certificate" else Library).record
    tubes, loop = record.tubes, record.loop
    asked = getattr(record, "requirements", None) or ()
    assert tubes.flow is not None and loop.rate is not None and loop.dt is not None
    whole = Tube(torch.from_numpy(tubes.tube_lower), torch.from_numpy(tubes.tube_upper))
    programs = from_record(loop.programs[0]), from_record(loop.rate)
    margins = [
        (from_record(one.margins), one, float(tubes.clearance[reference, len(tubes.constraint_names) - len(asked) + i]))
        for i, one in enumerate(asked)
    ]
    done = bad = 0
    worst, groups = -float("inf"), flows_of(tubes.flow, whole)
    turn = 0
    while done < rollouts:
        (index, flow), turn = groups[turn % len(groups)], turn + 1
        own = np.flatnonzero(tubes.cell_reference[index] == reference)
        if not len(own):
            continue
        count = min(BATCH, rollouts - done)
        part = _Cells.of(tubes, loop, reference, index[own], flow.select(torch.from_numpy(own)))
        most = part.solutions(programs, margins, count, generator)
        bad += int((~(most <= MARGIN)).sum())
        worst, done = max(worst, float(most.max())), done + count
    return Escapes(done, bad, worst)


@dataclass(frozen=True)
class _Cells:
    """Cells of one reference that are divided alike: where they begin, what is said of them, the numbers of the control
    at each instant, and the seconds that it may lag."""

    cells: Box
    tube: Tube
    flow: Flow
    w: Box
    windows: Tensor
    period: float
    lag: Box | None

    @staticmethod
    def of(tubes: Tubes, loop: LoopRecord, reference: int, index: np.ndarray, flow: Flow) -> _Cells:
        sides = [
            [torch.from_numpy(getattr(tubes, f"{name}_{side}")[index]) for side in ("lower", "upper")]
            for name in ("cell", "tube")
        ]
        w = Box(torch.from_numpy(tubes.disturbance_lower), torch.from_numpy(tubes.disturbance_upper))
        steps = tubes.tube_lower.shape[1] - 1
        windows = torch.zeros(steps, 0, dtype=torch.float64)
        if loop.lookahead and tubes.references is not None:
            rows = np.minimum(np.arange(steps)[:, None] + np.arange(1, loop.lookahead + 1), steps)
            windows = torch.from_numpy(tubes.references[reference][rows].reshape(steps, -1))
        lag = None if loop.lag is None else Box(*torch.from_numpy(loop.lag).unbind(1))
        assert loop.dt is not None
        return _Cells(Box(*sides[0]), Tube(*sides[1]), flow, w, windows, loop.dt, lag)

    def solutions(
        self, programs: tuple[Program, Program], margins: list, count: int, generator: torch.Generator
    ) -> Tensor:
        """How far each of so many solutions is outside at worst, ``(count,)``; negative inside."""
        law, field = programs
        solved = functools.partial(_solved, field)
        flow, tube, parts = self.flow, self.tube, self.flow.division.substeps
        lines, bulge = flow.lines(tube, self.w, self.period)
        per, h, n, steps = FINE // parts, self.period / FINE, self.w.dim, len(self.windows)
        cell = torch.randint(len(self.cells.lower), (count,), generator=generator)
        unit = torch.rand(count, n, dtype=torch.float64, generator=generator)
        unit = torch.where(torch.rand(count, 1, generator=generator) < 0.7, unit.round(), unit)
        x = self.cells.lower[cell] + unit * (self.cells.upper - self.cells.lower)[cell]
        signal, nothing = signals(self.w, steps, count, generator), torch.zeros(count, n, dtype=torch.float64)
        most, swing = torch.full((count,), -torch.inf, dtype=torch.float64), bulge.swing.expand_as(bulge.curve)

        def compare(x: Tensor, low: Tensor, high: Tensor, most: Tensor) -> Tensor:
            return torch.maximum(most, torch.maximum(low - x, x - high).amax(-1))

        def kept(x: Tensor, time: float, most: Tensor) -> Tensor:
            for program, one, margin in margins:
                if one.first <= time <= one.last:
                    found = program.run(x, nothing).control.expand(count, -1)
                    most = torch.maximum(most, margin - (found.amin(-1) if one.every else found.amax(-1)))
            return most

        held, past = None, []
        for k in range(steps):
            numbers = self.windows[k].expand(count, -1) if self.windows.shape[1] else None
            seen, seconds = x, torch.zeros(count, 2, dtype=torch.float64)
            if self.lag is not None and held is not None:
                seconds = self.lag.sample(count, generator)
                if k % 2:  # every other instant as early or as late as may be
                    seconds = torch.where(seconds > self.lag.center, self.lag.upper, self.lag.lower)
                seen = _measured(field, past, held, seconds[:, 1], self.period)
            u = law.run(seen, nothing, numbers).control.expand(count, -1)
            past, held = [], u if held is None else held
            for i in range(FINE):
                part, s = i // per, (i % per) / per
                row = k * parts + part
                most = compare(x, flow.lower[cell, k, part], flow.upper[cell, k, part], most)
                off = s * (1 - s) * (bulge.curve[cell, row] + swing[cell, row]) + bulge.rest[cell, row]
                low = (1 - s) * lines.lower[cell, row] + s * lines.lower[cell, row + 1] - off
                high = (1 - s) * lines.upper[cell, row] + s * lines.upper[cell, row + 1] + off
                most = kept(x, k + i / FINE, compare(x, low, high, most))
                v = signal[:, k * FINE + i]
                past.append((x, v))
                if self.lag is None:
                    x = solved(x, u, v, h)
                else:
                    old = (seconds[:, :1] - i * h).clamp(0.0, h)
                    x = solved(solved(x, held, v, old), u, v, h - old)
            held = u
            most = compare(x, tube.lower[cell, k + 1], tube.upper[cell, k + 1], most)
        return kept(x, float(steps), most)


def _solved(field: Program, x: Tensor, u: Tensor, w: Tensor, h: Tensor | float) -> Tensor:
    """The state some seconds later."""
    nothing = torch.zeros_like(x)

    def rate(x: Tensor) -> Tensor:
        return field.run(x, nothing, u).next + w

    a = rate(x)
    b = rate(x + h / 2 * a)
    c = rate(x + h / 2 * b)
    return x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c))


def _measured(
    field: Program, past: list[tuple[Tensor, Tensor]], held: Tensor, older: Tensor, period: float
) -> Tensor:  # fmt: skip
    """The state some seconds before the end of a period, from the last of its parts that began before."""
    h, row = period / FINE, torch.arange(len(older))
    place = ((period - older) / h).floor().clamp(max=FINE - 1).long()
    x, w = (torch.stack(side)[place, row] for side in zip(*past, strict=True))
    return _solved(field, x, held, w, (period - older - place * h)[:, None])


def continuous(path: Path) -> bool:
    """Whether a file holds bounded tubes in continuous time."""
    kind, _ = open_header(path)
    if kind.name not in ("certificate", "library"):
        return False
    tubes = read_artifact(path, Certificate if kind.name == "certificate" else Library).record.tubes
    return tubes.flow is not None and bool(np.isfinite(tubes.tube_lower).all() and np.isfinite(tubes.flow.lower).all())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rollouts", type=int, default=1_000_000, help="solutions altogether")
    parser.add_argument("--artifacts", type=Path, default=Path("artifacts"))
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    asked = [path for path in sorted(options.artifacts.rglob("*.h5")) if continuous(path)]
    if not asked:
        print(f"{options.artifacts}: no certificate in continuous time", file=sys.stderr)
        return 2
    generator, total = torch.Generator().manual_seed(options.seed), 0
    for path in asked:
        began = time.process_time()
        with torch.no_grad():
            found = compared(path, 0, options.rollouts // len(asked), generator)
        total += found.outside
        print(
            f"{path}: {found.rollouts} solutions, {found.outside} outside, nearest to a bound {found.worst:.3g} "
            f"(negative: inside), {time.process_time() - began:.0f} s",
            flush=True,
        )
    return int(total > 0)


if __name__ == "__main__":
    sys.exit(main())
