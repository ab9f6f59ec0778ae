"""On which side of each obstacle a path passes.

A *side* is an index per obstacle. In the plane: 0 passes with the obstacle on the right hand (to the left of it), 1
to the right of it. In space: 0 left, 1 over, 2 right, 3 under, as seen when flying from start to goal. Sides in the
plane tell homotopy classes apart; in space all paths around a ball are homotopic, and a side only says near which
direction a path passes, which is what separates the local optima there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sagemp_cli.scenes.scene import Ball, Obstacle

Array = NDArray[np.float64]

SIDE_NAMES = {2: ("left", "right"), 3: ("left", "over", "right", "under")}
"""Names of the sides by the scene's dimension; a side is an index into them."""


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
    return tuple(_side_of(path, middle_of(obstacle)) for obstacle in obstacles)


def side_label(sides: Sequence[int], dimension: int) -> str:
    """The sides as one letter per obstacle, e.g. ``"LR"``; empty without obstacles."""
    return "".join(SIDE_NAMES[dimension][side][0].upper() for side in sides)


def middle_of(obstacle: Obstacle) -> Array:
    """The middle of an obstacle, ``(d,)``."""
    if isinstance(obstacle, Ball):
        return np.array(obstacle.center)
    return 0.5 * (np.array(obstacle.lower) + np.array(obstacle.upper))


def _side_of(path: Array, middle: Array) -> int:
    if path.shape[1] == 2:
        offset = path - middle
        angle = np.arctan2(offset[:, 1], offset[:, 0])
        swept = np.diff(angle)
        swept = (swept + np.pi) % (2.0 * np.pi) - np.pi
        return 0 if swept.sum() <= 0.0 else 1
    nearest = path[np.linalg.norm(path - middle, axis=1).argmin()]
    return int((side_directions(path[0], path[-1]) @ (nearest - middle)).argmax())
