"""States that follow from the positions over time: velocity, heading, tilt. A robot says which of them are its own.

Differences are forward, ``(p_{k+1} - p_k) / dt``, as in the robots' Euler step, the last one repeated.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

GRAVITY = 9.81


def rate(values: Array, dt: float) -> Array:
    """The rate of change of values ``(K+1,)``."""
    steps = np.diff(values) / dt
    return np.append(steps, steps[-1])


def speed(px: Array, py: Array, dt: float) -> Array:
    """The speed of a robot in the plane."""
    return np.hypot(rate(px, dt), rate(py, dt))


def heading(px: Array, py: Array, dt: float) -> Array:
    """The direction in which a robot moves in the plane, continuous over turns; kept while it stands still."""
    velocity = np.stack([rate(px, dt), rate(py, dt)])
    moving = np.hypot(*velocity) > 1e-9
    if not moving.any():
        return np.zeros(velocity.shape[1])
    # Row k has the direction of the last moving row up to k; rows before the first take that one's.
    last = np.maximum.accumulate(np.where(moving, np.arange(len(moving)), -1))
    last[last < 0] = int(np.argmax(moving))
    return np.unwrap(np.arctan2(velocity[1], velocity[0])[last])


def planar_tilt(vx: Array, vz: Array, dt: float) -> Array:
    """The tilt at which thrust along the body's axis gives the velocity's differences under gravity."""
    return np.unwrap(np.arctan2(-rate(vx, dt), rate(vz, dt) + GRAVITY))


def tilt(vx: Array, vy: Array, vz: Array, psi: Array, dt: float) -> tuple[Array, Array]:
    """The pitch and the roll at which thrust gives the velocity's differences under gravity, at the yaw ``psi``."""
    ax, ay, up = rate(vx, dt), rate(vy, dt), rate(vz, dt) + GRAVITY
    ahead, left = ax * np.cos(psi) + ay * np.sin(psi), ay * np.cos(psi) - ax * np.sin(psi)
    return np.unwrap(np.arctan2(ahead, up)), np.arctan2(-left, np.hypot(ahead, up))
