"""Rechecking stored tubes in another scene (paper, V-E: 0.122 s): trees of boxes beside the full judgement.

    python benchmarks/recheck.py [--tubes 1000] [--horizon 100] [--obstacles 20] [--scenes 200] [--seed 0]

Tubes along random smooth plans through a room of 10 x 6 m with discs and blocks at random, each step judged over the
whole of its eight parts. Milliseconds of processor time of one scene (median and worst over the scenes) for obstacles
of several sizes, the seconds that preparing the trees takes once, and that of the full judgement of verify in the same
run; both have to agree on every tube.
"""

from __future__ import annotations

import argparse
import statistics
import time

import numpy as np
import torch

from sagemp_cli.scenes.scene import Ball, Block, Scene
from sagemp_cli.sets import Between, Box, Tube
from sagemp_cli.verification.bounding_volumes import BoundingVolumes
from sagemp_cli.verification.verdict import positions_over_time


def plans(rng: np.random.Generator, tubes: int, horizon: int) -> Tube:
    """Tubes 0.1 m wide along sums of three sine waves from left to right."""
    t = np.linspace(0.0, 1.0, horizon + 1)
    waves = rng.normal(size=(tubes, 3)) @ np.sin(np.pi * np.outer((1, 2, 3), t))
    center = torch.from_numpy(np.stack([np.broadcast_to(10 * t, waves.shape), waves], -1))
    return Tube(center - 0.05, center + 0.05)


def room(rng: np.random.Generator, obstacles: int, size: float) -> Scene:
    """Half discs, half blocks, anywhere in the room but at its ends."""
    places = rng.uniform((1, -3), (9, 3), (obstacles, 2))
    found = [
        Ball((x, y), size, f"disc {i}") if i % 2 else Block((x - size, y - size), (x + size, y + size), f"block {i}")
        for i, (x, y) in enumerate(places.tolist())
    ]
    walls = Box(torch.tensor([-1.0, -12.0]).double(), torch.tensor([11.0, 12.0]).double())
    return Scene(walls, tuple(found), walls)


def main() -> None:
    """Print one row for each size of obstacles."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, value in (("tubes", 1000), ("horizon", 100), ("obstacles", 20), ("scenes", 200), ("seed", 0)):
        options.add_argument(f"--{name}", type=int, default=value)
    chosen = options.parse_args()
    torch.set_num_threads(1)
    rng = np.random.default_rng(chosen.seed)
    tube = plans(rng, chosen.tubes, chosen.horizon)
    began = time.process_time()
    over = positions_over_time(tube, (0, 1), Between.SEGMENTS)
    volumes = BoundingVolumes.of(over)
    print(f"{chosen.tubes} tubes x {chosen.horizon} steps x {chosen.obstacles} obstacles, {chosen.scenes} scenes")
    print(f"prepared once in {time.process_time() - began:.3f} s")
    print(f"{'size':>6} {'median':>10} {'worst':>10} {'in full':>10} {'clear':>7}")
    for size in (0.02, 0.1, 0.3, 0.6):
        scenes = [room(rng, chosen.obstacles, size) for _ in range(chosen.scenes)]
        took, clear = [], []
        for scene in scenes:
            began = time.process_time()
            clear.append(volumes.clear(scene))
            took.append(1e3 * (time.process_time() - began))
        began = time.process_time()
        full = (scenes[0].clearances(over) > 0).flatten(1).all(1).numpy()
        whole = 1e3 * (time.process_time() - began)
        assert (full == clear[0]).all(), "the trees and the full judgement disagree"
        share = np.mean(clear)
        print(f"{size:>4} m {statistics.median(took):>7.2f} ms {max(took):>7.2f} ms {whole:>7.0f} ms {share:>7.1%}")


if __name__ == "__main__":
    main()
