"""Random closed loops against every native propagator: does a rollout leave its tube?

A program is a tree of operations per next state, the ones among them that are written in several ways (angles, larger
and smaller ones, clamps, quotients, absolute values) more often than others. Attacked are the corners, a grid, random
points, and what a local search makes of the worst of them. Run as a script it tries thousands and prints what it found:

    python benchmarks/random_programs.py --angles 200 --count 4000
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections import Counter
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.crown.best import Best
from sagemp_cli.reachability.crown.crown import Crown
from sagemp_cli.reachability.interval.interval import Interval
from sagemp_cli.sets import Box, Tube

UNARY = {
    "sin": torch.sin,
    "cos": torch.cos,
    "tanh": torch.tanh,
    "sigmoid": torch.sigmoid,
    "exp": lambda x: torch.exp(0.5 * x),
    "log": lambda x: torch.log(x * x + 0.5),
    "root": lambda x: torch.sqrt(torch.relu(x)),
    "length": lambda x: torch.sqrt(x * x + 0.01),
    "square": torch.square,
    "cube": lambda x: x**3,
    "relu": torch.relu,
    "leaky": lambda x: nn.functional.leaky_relu(x, 0.1),
    "abs": torch.abs,
    "clamp": lambda x: torch.clamp(x, -0.4, 0.7),
    "reciprocal": lambda x: 1.0 / (1.5 + torch.sin(x)),
    "silu": nn.functional.silu,
    "softplus": nn.functional.softplus,
    "atan": torch.atan,
    "gelu": nn.functional.gelu,
    "gelu tanh": lambda x: nn.functional.gelu(x, approximate="tanh"),
    "mish": nn.functional.mish,
    "softsign": nn.functional.softsign,
    "hardswish": lambda x: nn.functional.hardswish(2 * x),
    "erf": torch.erf,
    "elu": lambda x: nn.functional.elu(x, 1.6),
    "power": lambda x: torch.abs(x) ** 1.3,
    "round": lambda x: 0.25 * torch.round(4 * x),
    "floor": torch.floor,
    "sign": torch.sign,
    "wrap": lambda x: torch.atan2(torch.sin(3 * x), torch.cos(3 * x)),
    "remainder": lambda x: torch.remainder(x, 1.5),
    "fmod": lambda x: torch.fmod(x, 1.5),
    "limited": lambda x: torch.where(x > 0.5, 0.5 + 0 * x, x),
    "root where positive": lambda x: torch.where(x > 0, torch.sqrt(x), -0.1 * x),
    "inside": lambda x: ((x > -0.3) & (x <= 0.6)).double() * x,
    "shift": lambda x: 0.7 * x - 0.4,
    "up": lambda x: x + 1.3,
}
BINARY = {
    "add": lambda a, b: a + b,
    "subtract": lambda a, b: a - b,
    "multiply": lambda a, b: a * b,
    "divide": lambda a, b: a / (1.2 + b * b),
    "share": lambda a, b: torch.exp(a) / (torch.exp(a) + torch.exp(b)),
    "angle": torch.atan2,
    "angle away": lambda a, b: torch.atan2(a, 1.2 + b),
    "angle up": lambda a, b: torch.atan2(1.5 + a, b),
    "maximum": torch.maximum,
    "minimum": torch.minimum,
    "within": lambda a, b: torch.clamp(a, min=-torch.abs(b), max=torch.abs(b)),
    "branch": lambda a, b: torch.where(a > 0.2, b, -a),
    "switch": lambda a, b: torch.where(a >= b, torch.sin(a), 0.3 * b),
    "larger by hand": lambda a, b: torch.where(a < b, b, a),
    "log of a sum": torch.logaddexp,
    "softmax": lambda a, b: torch.softmax(torch.stack([2 * a, b, a - b], -1), -1)[..., 0],
    "normalised": lambda a, b: torch.nn.functional.layer_norm(torch.stack([a, b, 0.3 * a + 0.2], -1), (3,), eps=0.1)[
        ..., 1
    ],
    "norm": lambda a, b: torch.sqrt(a * a + b * b),
}
CHOOSING = (
    "branch",
    "switch",
    "larger by hand",
    "angle",
    "angle away",
    "angle up",
    "maximum",
    "minimum",
    "within",
    "divide",
    "share",
)


@dataclass(frozen=True)
class RandomLoop:
    """``x_{k+1} = shrink * tree(x_k, w_k)`` per state, the same at every step.

    Attributes:
        trees: one per state: "x0", "x1", ..., "w0", a name with one or two trees.
    """

    trees: tuple[Any, ...]
    horizon: int

    @property
    def state_dim(self) -> int:
        return len(self.trees)

    def numbers(self) -> Tensor:
        return torch.zeros(self.horizon, 0, dtype=torch.float64)

    def step_given(self, numbers: Tensor, x: Tensor, w: Tensor) -> tuple[Tensor, None]:
        leaves = {f"x{i}": x[..., i] for i in range(self.state_dim)} | {"w0": w[..., 0]}
        return 0.8 * torch.stack([_value(tree, leaves) for tree in self.trees], dim=-1), None

    def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
        return self.step_given(self.numbers()[k], x, w)[0]


def _value(tree: Any, leaves: dict[str, Any]) -> Any:
    if isinstance(tree, str):
        return leaves[tree]
    name, *branches = tree
    return (UNARY.get(name) or BINARY[name])(*(_value(branch, leaves) for branch in branches))


def random_problem(seed: int) -> tuple[RandomLoop, Box, Box]:
    """A loop, a start box ``(n,)`` and a disturbance box ``(1,)``."""
    generator = torch.Generator().manual_seed(seed)

    def number(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))

    def chosen(values: Any) -> Any:
        return values[int(number(0, len(values) - 1e-9))]

    def tree(depth: int) -> Any:
        if depth == 0 or number(0, 1) < 0.1:
            return chosen([f"x{i}" for i in range(states)] * 3 + ["w0"])
        if number(0, 1) < 0.45:
            return chosen(list(UNARY)), tree(depth - 1)
        name = chosen(CHOOSING) if number(0, 1) < 0.6 else chosen(list(BINARY))
        return name, tree(depth - 1), tree(depth - 1)

    states = chosen([1, 1, 2, 2, 3])
    loop = RandomLoop(tuple(tree(chosen([2, 3, 4])) for _ in range(states)), chosen([1, 2, 3]))
    center = [number(-3, 3) for _ in range(states)]
    radius = [10 ** number(-2.5, 0.3) for _ in range(states)]
    return loop, Box.around(center, radius), Box.around([number(-0.3, 0.3)], [chosen([0.0, 0.05, 0.3])])


@torch.no_grad()
def worst_rollouts(loop: RandomLoop, start: Box, disturbance: Box, *, count: int = 600, rounds: int = 6) -> Tensor:
    """Rollouts ``(R, K+1, n)``: corners, random ones, and those that a local search moved outwards."""
    generator = torch.Generator().manual_seed(0)
    n, horizon = start.dim, loop.horizon

    def simulated(z: Tensor) -> Tensor:
        """From points of the unit box of start and disturbances."""
        x = start.center + start.radius * z[:, :n]
        w = disturbance.center + disturbance.radius * z[:, n:, None]
        states = [x]
        for k in range(horizon):
            states.append(loop.step(k, states[-1], w[:, k]))
        return torch.stack(states, dim=1)

    def drawn(rows: int) -> Tensor:
        return 2 * torch.rand(rows, n + horizon, generator=generator, dtype=torch.float64) - 1

    corners = torch.tensor(list(itertools.product((-1.0, 1.0), repeat=n + horizon)), dtype=torch.float64)
    z = torch.cat([corners, drawn(count), drawn(count // 2).sign()])
    found = [simulated(z)]
    size = 0.5
    for _ in range(rounds):
        flat = found[-1][:, 1:].flatten(1)
        best = torch.cat([flat.nan_to_num(-math.inf).argmax(0), flat.nan_to_num(math.inf).argmin(0)])
        near = z[best].repeat_interleave(24, 0)
        z = torch.cat([z[best], (near + size * drawn(len(near))).clamp(-1, 1)])
        found.append(simulated(z))
        size *= 0.4
    return torch.cat(found)


def escaped(tube: Tube, states: Tensor) -> float:
    """How far a rollout lies outside; 0 if none does. Rounding of the simulation is forgiven."""
    known = torch.isfinite(states).all(-1).all(-1)
    outside = torch.maximum(tube.lower - states[known], states[known] - tube.upper) - 1e-9 * (1 + states[known].abs())
    return max(0.0, float(outside.max())) if bool(known.any()) else 0.0


PROPAGATORS = {
    "affine": Affine(),
    "crown": Crown(),
    "best": Best(),
    "best of three": Best(rounds=3),
    "interval": Interval(),
}


@dataclass(frozen=True)
class Angle:
    """``x' = atan2(f(x), g(x))``, one step of one state."""

    trees: tuple[Any, Any]
    horizon: int = 1
    state_dim: int = 1

    def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
        return torch.atan2(*(_value(tree, {"x0": x}) + 0 * x for tree in self.trees)) + 0 * w


def angles(count: int, boxes: int = 64) -> None:
    """Angles of random curves over many intervals each: the direction moves between the passes of ``best``."""
    generator = torch.Generator().manual_seed(1)
    names, grid = list(UNARY), torch.linspace(-1, 1, 301, dtype=torch.float64)
    escapes, bounded, begin = 0, 0, time.perf_counter()
    for _ in range(count):
        picks = torch.randint(len(names), (2, 2), generator=generator).tolist()
        loop = Angle(tuple((names[a], (names[b], "x0")) for a, b in picks))
        center = 6 * torch.rand(boxes, 1, generator=generator, dtype=torch.float64) - 3
        radius = 10 ** (2 * torch.rand(boxes, 1, generator=generator, dtype=torch.float64) - 1.7)
        tube = Best(rounds=3).propagate(loop, Box(center - radius, center + radius), Box.around([0.0], [0.0]))
        values = loop.step(0, (center + radius * grid)[..., None], torch.zeros(1, dtype=torch.float64))[..., 0]
        low, high = values.amin(-1) + 1e-12, values.amax(-1) - 1e-12
        wrong = (low < tube.lower[:, 1, 0] - 1e-9) | (high > tube.upper[:, 1, 0] + 1e-9)
        escapes += int(wrong.sum())
        bounded += int((tube.width[:, 1, 0] < 6.28).sum())
        if bool(wrong.any()):
            print(f"a rollout leaves the tube of best: {loop.trees}", flush=True)
    print(
        f"{count * boxes} angles in {time.perf_counter() - begin:.0f} s: {escapes} escapes, "
        f"{bounded} bounded by less than the whole circle",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=4000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--angles", type=int, default=200)
    options = parser.parse_args()
    angles(options.angles)
    torch.set_num_threads(1)
    wrong, infinite, needless, begin = Counter(), Counter(), Counter(), time.perf_counter()
    for done, seed in enumerate(range(options.first, options.first + options.count), 1):
        if done % 100 == 0:
            print(f"{done} programs, {sum(wrong.values())} escapes", flush=True)
        loop, start, disturbance = random_problem(seed)
        states = worst_rollouts(loop, start, disturbance)
        finite = {}
        for name, propagator in PROPAGATORS.items():
            tube = propagator.propagate(loop, start, disturbance)
            finite[name] = bool(torch.isfinite(tube.width).all())
            distance = escaped(tube, states)
            if distance > 0:
                wrong[name] += 1
                print(f"seed {seed}: a rollout leaves the tube of {name} by {distance:.3g}: {loop.trees}", flush=True)
            infinite[name] += not finite[name]
        for name in finite:
            needless[name] += finite["interval"] and not finite[name]
    print(f"{options.count} programs in {time.perf_counter() - begin:.0f} s")
    for name in PROPAGATORS:
        print(
            f"{name:>14}: {wrong[name]} escapes, {infinite[name]} infinite, "
            f"of these {needless[name]} where interval arithmetic is finite"
        )


if __name__ == "__main__":
    main()
