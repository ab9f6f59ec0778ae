"""First guesses of a path for every combination of sides (see :mod:`sagemp_cli.scenes.sides`) of the obstacles."""

from __future__ import annotations

import itertools

import numpy as np
import torch
from numpy.typing import NDArray

from sagemp_cli.scenes import Ball, Obstacle, Scene
from sagemp_cli.scenes.sides import middle_of, side_directions

Array = NDArray[np.float64]

FREE = -1
"""In place of a side: the obstacle does not lie between start and goal, so no side is asked for."""


def guesses(
    scene: Scene, start: Array, goal: Array, *, horizon: int, margin: float, longest_detour: float = 1.3
) -> list[tuple[tuple[int, ...], Array]]:
    """One path of positions ``(K+1, d)`` per plausible combination of sides, shortest first.

    Each path runs through a via point beside every obstacle that lies between start and goal, at ``margin`` (plus a
    fifth) from it, rounded off and walked at constant speed. Combinations are left out when a via point leaves the
    workspace or lies in another obstacle, or when the path is longer than ``longest_detour`` times the shortest
    one. A guess need not be feasible; it only says near which optimum to begin.

    Returns:
        Pairs of the sides asked for (FREE where an obstacle is not on the way) and the path; none where every via
        point is blocked.
    """
    way, directions = goal - start, side_directions(start, goal)
    length = max(float(way @ way), 1e-12)
    progress = [float((middle_of(o) - start) @ way) / length for o in scene.obstacles]
    choices = [range(len(directions)) if 0.0 < p < 1.0 else (FREE,) for p in progress]
    order = np.argsort(progress, kind="stable")
    found = []
    for sides in itertools.product(*choices):
        vias = [
            middle_of(o) + directions[side] * (_extent(o, directions[side]) + 1.2 * margin)
            for o, side in ((scene.obstacles[i], sides[i]) for i in order)
            if side != FREE
        ]
        if vias and not _free(scene, np.stack(vias)):
            continue
        path, travelled = _rounded(np.stack([start, *vias, goal]), horizon)
        found.append((travelled, sides, path))
    if not found:
        return []
    found.sort(key=lambda item: (item[0], item[1]))
    return [(sides, path) for travelled, sides, path in found if travelled <= longest_detour * found[0][0]]


def _extent(obstacle: Obstacle, direction: Array) -> float:
    """How far the obstacle reaches from its middle along a unit vector."""
    if isinstance(obstacle, Ball):
        return obstacle.radius
    return float(0.5 * (np.array(obstacle.upper) - np.array(obstacle.lower)) @ np.abs(direction))


def _free(scene: Scene, points: Array) -> bool:
    return bool((scene.signed_distance(torch.from_numpy(points)) > 0.0).all())


def _rounded(corners: Array, horizon: int) -> tuple[Array, float]:
    """The polyline through ``corners`` at constant speed with its corners rounded off, and its length."""
    pieces = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(pieces)])
    at = np.linspace(0.0, along[-1], horizon + 1)
    path = np.stack([np.interp(at, along, column) for column in corners.T], axis=1)
    for _ in range(horizon // 2):  # each pass averages neighbours; together a bell about a tenth of the path wide
        path[1:-1] = 0.25 * path[:-2] + 0.5 * path[1:-1] + 0.25 * path[2:]
    return path, float(along[-1])
