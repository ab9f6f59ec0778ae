"""Wide controllers: ``python benchmarks/wide.py [--width 256] [--steps 100] [--radius 0.08] [--only affine best]``.

Four states under a network of two wide layers whose last one is fitted to a linear feedback, the others drawn. Prints
processor time and width (mean over steps and states, relative to ``affine``). To compare versions of the package run it
with ``PYTHONPATH`` at each in turns.
"""

from __future__ import annotations

import argparse
import math
import time

import torch
from torch import Tensor

from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.crown.best import Best
from sagemp_cli.reachability.crown.crown import Crown
from sagemp_cli.reachability.observed import Observed, observed
from sagemp_cli.sets import Box

PROPAGATORS = {"affine": Affine(), "crown": Crown(), "best": Best()}


def wide_loop(width: int, steps: int, radius: float) -> Observed:
    """Two double integrators."""
    draw = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=draw, dtype=torch.float64)

    scale = math.sqrt(2 / width)
    first, second = (normal(width, 4), 1.5 * normal(width)), (scale * normal(width, width), 1.5 * scale * normal(width))

    def features(x: Tensor) -> Tensor:
        for weight, bias in (first, second):
            x = torch.relu(torch.nn.functional.linear(x, weight, bias))
        return x

    x = 3 * torch.rand(4000, 4, generator=draw, dtype=torch.float64) - 1.5
    gain = torch.tensor([[1.2, 0, 1.8, 0], [0, 1.2, 0, 1.8]], dtype=torch.float64)
    known = torch.nn.functional.pad(features(x), (0, 1), value=1.0)
    last = torch.linalg.solve(
        known.mT @ known + 10 * torch.eye(width + 1, dtype=torch.float64), -known.mT @ x @ gain.mT
    )

    def step(x: Tensor, w: Tensor) -> Tensor:
        u = torch.nn.functional.linear(features(x), last[:-1].mT, last[-1])
        place, speed = x[..., :2], x[..., 2:]
        return torch.cat([place + 0.1 * speed, speed + 0.1 * (u - 0.2 * torch.sin(place)) + w], -1)

    return observed(step, Box.around([0.5, -0.3, 0, 0], [radius] * 4), Box.around([0.0, 0.0], [0.002] * 2), steps)


def main() -> None:
    """Measure what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--width", type=int, default=256)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--radius", type=float, default=0.08)
    parser.add_argument("--only", nargs="+", default=list(PROPAGATORS), choices=list(PROPAGATORS))
    options = parser.parse_args()
    torch.set_num_threads(1)
    seen, reference = wide_loop(options.width, options.steps, options.radius), None
    for name in ["affine", *(n for n in options.only if n != "affine")]:
        began = time.process_time()
        tube = PROPAGATORS[name].propagate(seen.loop, seen.start, seen.disturbance)
        spent = time.process_time() - began
        reference = tube.width[1:] if reference is None else reference
        print(f"{name:7} {spent:7.2f} s  width {float((tube.width[1:] / reference).mean()):.4f}", flush=True)


if __name__ == "__main__":
    main()
