"""Waypoints to a reference: straight lines with rounded corners, driven at constant speed, heading filled in."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sagemp_cli.errors import ConfigError

Array = NDArray[np.float64]

_FINE = 0.02
"""Radians of an arc per piece of the polyline that stands for it."""


@dataclass(frozen=True)
class Drive:
    """How a polyline of waypoints is driven.

    The paper interpolates the waypoints linearly. A unicycle cannot turn on the spot while it drives, so corners
    are rounded here, by the circle of ``corner_radius`` that touches both lines (smaller where a line is too short
    for it), and the path leaves the start along its heading for ``lead`` metres. With both 0 the reference is the plain
    polyline.

    Attributes:
        corner_radius: metres.
        lead: metres straight on from the start; at most a third of the way to the first waypoint.
        ramp: seconds in which the speed goes from the start's to the constant one (a start without a speed among its
            states stands still); 0 has the constant speed from the first step.
    """

    corner_radius: float = 0.3
    lead: float = 0.2
    ramp: float = 0.0

    def __post_init__(self) -> None:
        if not all(0 <= value < math.inf for value in (self.corner_radius, self.lead, self.ramp)):
            raise ConfigError(
                "planner.drive: corner_radius, lead and ramp must be zero or positive, "
                f"found {self.corner_radius}, {self.lead} and {self.ramp}"
            )


def reference_of(places: Array, start: Array, *, horizon: int, dt: float, drive: Drive) -> Array:
    """The reference ``(K+1, n)`` from a start through places, the last of which is reached at step K.

    Row 0 is the start, to the last bit. The heading of row k is that of the way to row k+1, as in an Euler step,
    without jumps of a full turn; the speed of a four-state unicycle is that of the same step.

    Args:
        places: ``(J, 2)`` metres, at least one.
        start: ``[px, py, theta]`` or ``[px, py, theta, v]``.
        horizon: number of steps K.
        dt: seconds a step.
        drive: corners and speed.
    """
    path = rounded(_corners(places, start, drive.lead), drive.corner_radius)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    first = float(start[3]) if len(start) > 3 else 0.0
    at = _travelled(along[-1], first, horizon=horizon, dt=dt, ramp=drive.ramp)
    positions = np.stack([np.interp(at, along, column) for column in path.T], axis=1)
    steps = np.diff(positions, axis=0)
    moving = np.linalg.norm(steps, axis=1) > 1e-9
    heading = np.full(horizon, float(start[2]))
    heading[moving] = np.arctan2(steps[moving, 1], steps[moving, 0])
    for k in np.flatnonzero(~moving):
        heading[k] = heading[k - 1] if k else float(start[2])
    heading = np.unwrap(np.concatenate([start[2:3], heading]))[1:].astype(np.float64)
    reference = np.concatenate([positions, np.append(heading, heading[-1])[:, None]], axis=1)
    if len(start) > 3:
        speed = np.asarray(np.linalg.norm(steps, axis=1) / dt, dtype=np.float64)
        reference = np.concatenate([reference, np.append(speed, speed[-1])[:, None]], axis=1)
    reference[0] = start
    return reference


def rounded(corners: Array, radius: float) -> Array:
    """A polyline ``(C, 2)`` with its corners replaced by arcs of at most ``radius`` that touch both neighbours.

    An arc takes at most half of a piece between two corners and all of a piece at an end, so arcs never overlap and
    straight pieces stay where they are. The path comes within ``radius (1 / cos(turn / 2) - 1)`` of every corner.
    """
    out = [corners[:1]]
    last = len(corners) - 2
    for i in range(1, last + 1):
        corner = corners[i]
        a, b = corners[i - 1] - corner, corners[i + 1] - corner
        lengths = np.linalg.norm(a), np.linalg.norm(b)
        a, b = a / lengths[0], b / lengths[1]
        turn = math.pi - math.acos(float(np.clip(a @ b, -1.0, 1.0)))
        if radius == 0 or turn < 1e-6 or turn > math.pi - 1e-3:  # a full reversal has no arc
            out.append(corner[None])
            continue
        room = min(lengths[0] * (1.0 if i == 1 else 0.5), lengths[1] * (1.0 if i == last else 0.5))
        reach = min(radius * math.tan(turn / 2), room)
        actual = reach / math.tan(turn / 2)
        middle = corner + (a + b) / np.linalg.norm(a + b) * (actual / math.cos(turn / 2))
        begin, end = corner + reach * a - middle, corner + reach * b - middle
        share = np.linspace(0.0, 1.0, max(2, math.ceil(turn / _FINE)))[:, None]
        out.append(middle + (np.sin((1 - share) * turn) * begin + np.sin(share * turn) * end) / math.sin(turn))
    return np.concatenate([*out, corners[-1:]])


def _corners(places: Array, start: Array, lead: float) -> Array:
    """Start, a point straight ahead of it, and the places; those that add nothing are left out."""
    first = np.linalg.norm(places - start[:2], axis=1)
    first = float(first[first > 0].min(initial=math.inf))
    ahead = min(lead, first / 3)
    points = [start[:2]]
    if 0 < ahead < math.inf:
        points.append(start[:2] + ahead * np.array([math.cos(start[2]), math.sin(start[2])]))
    for place in places:
        if np.linalg.norm(place - points[-1]) > 1e-6:
            points.append(place)
    if len(points) == 1:
        points.append(points[0])
    return np.stack(points).astype(np.float64)


def _travelled(length: float, first: float, *, horizon: int, dt: float, ramp: float) -> Array:
    """Metres along the path at steps 0..K: the speed goes from ``first`` to a constant one over ``ramp`` seconds."""
    seconds, total = dt * np.arange(horizon + 1), dt * horizon
    ramp = min(ramp, total)
    cruise = (length - 0.5 * ramp * first) / (total - 0.5 * ramp)
    if cruise < 0 or ramp == 0:  # the ramp alone goes too far: no ramp then
        return np.asarray(length * seconds / total, dtype=np.float64)
    rising = np.minimum(seconds, ramp)
    gone = first * rising + 0.5 * (cruise - first) * rising**2 / ramp + cruise * (seconds - rising)
    return np.minimum(gone, length)
