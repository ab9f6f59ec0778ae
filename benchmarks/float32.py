"""What float32 costs: tubes of certified plans with the tracker in float32, against the same in real arithmetic.

    python benchmarks/float32.py [--artifacts artifacts] [--rollouts 20000]

Takes every ``certificate.h5`` of discrete time below the artifacts folder (run the experiments first). For its first
reference it prints how much wider the tube gets, and how much longer it takes (processor time, in turns), and rolls the
loop out with the controls computed in float32 in four ways: by torch, and by numpy with sums in three orders, one of
them with fused multiply-add. Ends with exit code 1 if a state is outside of the tube.
"""

from __future__ import annotations

import argparse
import copy
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.loop.onnx_format.layers import Network
from sagemp_cli.loop.onnx_format.writing import as_network
from sagemp_cli.loop.tracker import Tracker
from sagemp_cli.pipeline.models import robot_from, tracker_from
from sagemp_cli.pipeline.problem import problem_of
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.sets import Box, Tube
from sagemp_cli.storage import Certificate, DynamicsModel, TrackerModel, read_artifact

TURNS = 3
FUNCTIONS: dict[str, Callable[..., np.ndarray]] = {
    "leaky_relu": lambda a, slope: np.where(a > 0, a, a * np.float32(slope)),
    "clamp": lambda a, low, high: np.clip(a, np.float32(low), np.float32(high)),
    "add": np.add,
    "mul": np.multiply,
}


def product(a: np.ndarray, weight: np.ndarray, bias: np.ndarray, order: np.ndarray, *, fused: bool) -> np.ndarray:
    """``W a + b`` in float32, term by term in an order, of which the last one is the bias."""
    total = np.zeros((len(a), len(bias)), np.float32)
    for j in order:
        if j == a.shape[1]:
            total = total + bias
        elif fused:  # exact in float64 but for a rounding that is 2^-29 of that to float32
            total = (a[:, j, None].astype(np.float64) * weight[:, j] + total).astype(np.float32)
        else:
            total = total + a[:, j, None] * weight[:, j]
    return total


def in_order(network: Network, x: np.ndarray, seed: int) -> np.ndarray:
    """A network's outputs in float32, in an order of one's own."""
    rng, values = np.random.default_rng(seed), [x]
    for i, layer in enumerate(network.layers, start=1):
        reads = [values[r] for r in layer.reads]
        if layer.kind == "linear":
            weight, bias = (network.constant(i, name).numpy().astype(np.float32) for name in ("weight", "bias"))
            order = rng.permutation(weight.shape[1] + 1) if seed else np.arange(weight.shape[1] + 1)
            values.append(product(reads[0], weight, bias, order, fused=seed == 2))
        elif layer.kind == "constant":
            values.append(network.constant(i, "value").numpy().astype(np.float32)[None])
        else:
            values.append(FUNCTIONS[layer.kind](*reads, *layer.numbers).astype(np.float32))
    return values[-1]


def outside(loop: ClosedLoop, tracker: Tracker, start: Box, w: Box, tube: Tube, count: int) -> int:
    """How many rollouts leave the tube."""
    g = torch.Generator().manual_seed(0)
    network = as_network(tracker)
    left = 0
    for way in range(4):
        x = start.sample(count, g)
        bad = torch.zeros(count, dtype=torch.bool)
        for k in range(loop.horizon):
            errors = tracker.features(loop.window(k), x)
            if way == 3:
                u = tracker(errors)
            else:
                u = torch.from_numpy(in_order(network, errors.float().flatten(-2).numpy(), way)).double()
            noise = torch.where(torch.rand(count, w.dim, generator=g) < 0.5, w.lower, w.upper)
            x = stepped(loop, x, u, noise)
            bad |= ((x < tube.lower[k + 1]) | (x > tube.upper[k + 1])).any(-1)
        left += int(bad.sum())
    return left


def stepped(loop: ClosedLoop, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
    """The next states under these controls."""
    return loop.dynamics.step(x, u, w)


@torch.no_grad()
def measured(path: Path, rollouts: int) -> int:
    """Print a certificate's figures; rollouts that left their tube."""
    artifact = read_artifact(path, Certificate)
    tubes, problem = artifact.record.tubes, problem_of(artifact.header.config)
    if tubes.between == "continuous":
        return 0
    parents = {parent.role: path.parent / parent.path for parent in artifact.header.parents}
    if "dynamics" in parents:
        robot_from(read_artifact(parents["dynamics"], DynamicsModel), problem.dynamics)
    real = tracker_from(read_artifact(parents["tracker"], TrackerModel)).requires_grad_(False)
    assert isinstance(real, Tracker)
    narrow = copy.deepcopy(real)
    narrow.precision = "float32"
    own = torch.as_tensor(tubes.cell_reference) == 0
    cells = Box(torch.as_tensor(tubes.cell_lower)[own], torch.as_tensor(tubes.cell_upper)[own])
    found: dict[str, Tube] = {}
    seconds = {"real": 0.0, "float32": 0.0}
    for _ in range(TURNS):
        for tracker in (real, narrow):
            loop = ClosedLoop(problem.dynamics, tracker, torch.as_tensor(tubes.references[0]))
            began = time.process_time()
            found[tracker.precision] = Affine().propagate(loop, cells, problem.disturbance).hull()
            seconds[tracker.precision] += time.process_time() - began
    both = [found[name].width[1:] for name in ("float32", "real")]
    wider = (both[0] / both[1])[both[1] > 0]
    start = Box(torch.as_tensor(tubes.start_lower[0]), torch.as_tensor(tubes.start_upper[0]))
    loop = ClosedLoop(problem.dynamics, narrow, torch.as_tensor(tubes.references[0]))
    left = outside(loop, narrow, start, problem.disturbance, found["float32"], rollouts)
    print(
        f"{path.parent.name}: {len(cells.lower)} cells, tube wider by a factor of 1 + {float(wider.mean()) - 1:.2g} "
        f"(most 1 + {float(wider.max()) - 1:.2g}), time {seconds['float32'] / seconds['real']:.2f} times that in real "
        f"arithmetic; {left} of {4 * rollouts} rollouts in float32 outside"
    )
    return left


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--artifacts", type=Path, default=Path("artifacts"))
    parser.add_argument("--rollouts", type=int, default=20_000)
    given = parser.parse_args()
    torch.set_num_threads(1)
    return int(sum(measured(path, given.rollouts) for path in sorted(given.artifacts.glob("*/certificate.h5"))) > 0)


if __name__ == "__main__":
    sys.exit(main())
