"""On which side of each obstacle a path passes, and first guesses of a path for every combination of sides.

A *side* is an index per obstacle. In the plane: 0 passes with the obstacle on the right hand (to the left of it), 1
to the right of it. In space: 0 left, 1 over, 2 right, 3 under, as seen when flying from start to goal. Sides in the
plane tell homotopy classes apart; in space all paths around a ball are homotopic, and a side only says near which
direction a path passes, which is what separates the local optima there.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from sagemp_cli.scenes import Ball, Obstacle, Scene

Array = NDArray[np.float64]

SIDE_NAMES = {2: ("left", "right"), 3: ("left", "over", "right", "under")}
"""Names of the sides by the scene's dimension; a side is an index into them."""

FREE = -1
"""In place of a side: the obstacle does not lie between start and goal, so no side is asked for."""


def side_directions(start: Array, goal: Array) -> Array:
    """Unit vectors ``(sides, d)`` at right angles to the way from start to goal, one for each of SIDE_NAMES."""
    way = (goal - start) / max(float(np.linalg.norm(goal - start)), 1e-12)
    if len(way) == 2:
        left = np.array([-way[1], way[0]])
        return np.stack([left, -left])
    up = np.array([0.0, 0.0, 1.0]) if abs(way[2]) < 0.99 else np.array([1.0, 0.0, 0.0])
    left = np.cross(up, way)
    left /= np.linalg.norm(left)
    over = np.cross(way, left)
    return np.stack([left, over, -left, -over])


def sides_of(path: Array, obstacles: Sequence[Obstacle]) -> tuple[int, ...]:
    """The side on which a path of positions ``(K+1, d)`` passes each obstacle.

    In the plane this is the sign of the angle swept around the obstacle's middle, invariant under deformations of
    the path that keep its ends and do not cross the middle. In space it is the direction nearest to the
    obstacle-to-path offset where the path comes closest.
    """
    return tuple(_side_of(path, _middle(obstacle)) for obstacle in obstacles)


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
    progress = [float((_middle(o) - start) @ way) / length for o in scene.obstacles]
    choices = [range(len(directions)) if 0.0 < p < 1.0 else (FREE,) for p in progress]
    order = np.argsort(progress, kind="stable")
    found = []
    for sides in itertools.product(*choices):
        vias = [
            _middle(o) + directions[side] * (_extent(o, directions[side]) + 1.2 * margin)
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


def _middle(obstacle: Obstacle) -> Array:
    if isinstance(obstacle, Ball):
        return np.array(obstacle.center)
    return 0.5 * (np.array(obstacle.lower) + np.array(obstacle.upper))


def _extent(obstacle: Obstacle, direction: Array) -> float:
    """How far the obstacle reaches from its middle along a unit vector."""
    if isinstance(obstacle, Ball):
        return obstacle.radius
    return float(0.5 * (np.array(obstacle.upper) - np.array(obstacle.lower)) @ np.abs(direction))


def _side_of(path: Array, middle: Array) -> int:
    if path.shape[1] == 2:
        offset = path - middle
        angle = np.arctan2(offset[:, 1], offset[:, 0])
        swept = np.diff(angle)
        swept = (swept + np.pi) % (2.0 * np.pi) - np.pi
        return 0 if swept.sum() <= 0.0 else 1
    nearest = path[np.linalg.norm(path - middle, axis=1).argmin()]
    return int((side_directions(path[0], path[-1]) @ (nearest - middle)).argmax())


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
