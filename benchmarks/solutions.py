"""Soundness campaign in continuous time: simulated solutions against what certificates say at and between the instants.

    python benchmarks/solutions.py [--rollouts 1000000] [--artifacts artifacts]

Takes every ``certificate.h5`` below the artifacts folder that is in continuous time. Starts are corners and points of
its cells; signals of w are vertices of W, held, switched at random, or switched at 1 to 64 times the sample rate, in
all states together or in each by itself; of a control that lags delays and jitters are random and, at every other
instant, as small or as large as may be. The ODE is integrated by the classical Runge-Kutta method in 64 parts of a
period;
compared are the states at the instants with the tube, and those between with the box that the flow does not leave and
with the straight lines and their bulges. A difference of :data:`MARGIN` is granted to the integrator. Ends with exit
code 1 if a single solution ever was outside.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import torch
from torch import Tensor

from sagemp_cli.dynamics import Dynamics
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.pipeline.models import tracker_from
from sagemp_cli.pipeline.problem import problem_of
from sagemp_cli.pipeline.tubes import flows_of
from sagemp_cli.sets import Box, Tube
from sagemp_cli.storage import Certificate, TrackerModel, read_artifact

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


def _solved(robot: Dynamics, x: Tensor, u: Tensor, w: Tensor, h: Tensor | float) -> Tensor:
    """The state some seconds later."""
    a = robot.derivative(x, u) + w
    b = robot.derivative(x + h / 2 * a, u) + w
    c = robot.derivative(x + h / 2 * b, u) + w
    return x + h / 6 * (a + 2 * b + 2 * c + robot.derivative(x + h * c, u) + w)


def _measured(robot: Dynamics, past: list[tuple[Tensor, Tensor]], held: Tensor, older: Tensor) -> Tensor:
    """The state some seconds before the end of a period, from the last of its parts that began before."""
    h, row = robot.dt / FINE, torch.arange(len(older))
    place = ((robot.dt - older) / h).floor().clamp(max=FINE - 1).long()
    x, w = (torch.stack(side)[place, row] for side in zip(*past, strict=True))
    return _solved(robot, x, held, w, (robot.dt - older - place * h)[:, None])


def outside(path: Path, rollouts: int, generator: torch.Generator) -> tuple[int, float]:
    """How many solutions of how a certificate's first reference moves leave what it says, and by how much at worst."""
    artifact = read_artifact(path, Certificate)
    tubes, problem = artifact.record.tubes, problem_of(artifact.header.config)
    parents = {parent.role: path.parent / parent.path for parent in artifact.header.parents}
    tracker = tracker_from(read_artifact(parents["tracker"], TrackerModel)).requires_grad_(False)
    loop = ClosedLoop(problem.dynamics, tracker, torch.from_numpy(tubes.references[0]))
    cells = Box(torch.from_numpy(tubes.cell_lower), torch.from_numpy(tubes.cell_upper))
    tube = Tube(torch.from_numpy(tubes.tube_lower), torch.from_numpy(tubes.tube_upper))
    assert tubes.flow is not None
    ((_, flow),), w = flows_of(tubes.flow, tube), problem.disturbance
    lines, bulge = flow.lines(tube, w, loop.period)
    swing = bulge.swing.expand_as(bulge.curve)
    parts = flow.division.substeps
    per, h = FINE // parts, loop.period / FINE
    bad, worst, done = 0, -torch.inf, 0
    while done < rollouts:
        count = min(BATCH, rollouts - done)
        cell = torch.randint(len(cells.lower), (count,), generator=generator)
        unit = torch.rand(count, cells.dim, dtype=torch.float64, generator=generator)
        unit = torch.where(torch.rand(count, 1, generator=generator) < 0.7, unit.round(), unit)
        x = cells.lower[cell] + unit * (cells.upper - cells.lower)[cell]
        signal = signals(w, loop.horizon, count, generator)
        most = torch.full((count,), -torch.inf, dtype=torch.float64)

        def compare(x: Tensor, low: Tensor, high: Tensor, most: Tensor) -> Tensor:
            return torch.maximum(most, torch.maximum(low - x, x - high).amax(-1))

        held, past, late = None, [], problem.dynamics.lag.box
        for k in range(loop.horizon):
            seconds = late.sample(count, generator) if k else torch.zeros(count, 2, dtype=torch.float64)
            if k % 2:  # every other instant as early or as late as may be
                seconds = torch.where(seconds > late.center, late.upper, late.lower)
            u = loop.control(k, x if held is None else _measured(problem.dynamics, past, held, seconds[:, 1]))
            past, held = [], u if held is None else held
            for i in range(FINE):
                part, s = i // per, (i % per) / per
                row = k * parts + part
                most = compare(x, flow.lower[cell, k, part], flow.upper[cell, k, part], most)
                off = s * (1 - s) * (bulge.curve[cell, row] + swing[cell, row]) + bulge.rest[cell, row]
                low = (1 - s) * lines.lower[cell, row] + s * lines.lower[cell, row + 1] - off
                high = (1 - s) * lines.upper[cell, row] + s * lines.upper[cell, row + 1] + off
                most = compare(x, low, high, most)
                v = signal[:, k * FINE + i]
                past.append((x, v))
                if problem.dynamics.lag:
                    old = (seconds[:, :1] - i * h).clamp(0.0, h)
                    x = _solved(problem.dynamics, _solved(problem.dynamics, x, held, v, old), u, v, h - old)
                else:
                    x = _solved(problem.dynamics, x, u, v, h)
            held = u
            most = compare(x, tube.lower[cell, k + 1], tube.upper[cell, k + 1], most)
        bad += int((most > MARGIN).sum())
        worst, done = max(worst, float(most.max())), done + count
    return bad, worst


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rollouts", type=int, default=1_000_000, help="solutions altogether")
    parser.add_argument("--artifacts", type=Path, default=Path("artifacts"))
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    every = sorted(options.artifacts.rglob("certificate.h5"))
    asked = [p for p in every if read_artifact(p, Certificate).record.tubes.between == "continuous"]
    if not asked:
        print(f"{options.artifacts}: no certificate in continuous time", file=sys.stderr)
        return 2
    generator, total = torch.Generator().manual_seed(options.seed), 0
    for path in asked:
        began = time.process_time()
        with torch.no_grad():
            bad, worst = outside(path, options.rollouts // len(asked), generator)
        total += bad
        print(
            f"{path}: {options.rollouts // len(asked)} solutions, {bad} outside, nearest to a bound {worst:.3g} "
            f"(negative: inside), {time.process_time() - began:.0f} s",
            flush=True,
        )
    return int(total > 0)


if __name__ == "__main__":
    sys.exit(main())
