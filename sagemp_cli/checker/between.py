"""Where the position is between two samples, in balls: what a claim over the whole of every step is proved of.

Under forward Euler the robot moves along a straight line within a step. From a box at each sample follows one over each
part of a step: at ``s`` the position is in ``(1 - s) B_k + s B_{k+1}``, whose faces are linear in s, so that over
``[a, b]`` they are farthest at a or b. A solution of an ODE leaves the line: by how much is proved part by part
(:mod:`~sagemp_cli.checker.part`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sagemp_cli.checker.balls import arb, ball, balls

SEGMENTS, SAMPLES, CONTINUOUS = "segments", "samples", "continuous"
"""What a file may claim: that the safe set is kept over the whole of every step, at the samples only, or at all times
by every solution of an ODE."""
MOST_PARTS = 64

Sides = tuple[list[arb], list[arb]]
"""Lower and upper faces of a box."""


@dataclass(frozen=True)
class Line:
    """Where the state may be between two samples: near the straight line.

    Attributes:
        first, last: boxes around its ends.
        bend, rest: at ``s`` it is at most ``s (1 - s) bend + rest`` off the line; None: not at all.
        stay: a box that is not left in between; None: any.
    """

    first: Sides
    last: Sides
    bend: Sequence[arb] | None = None
    rest: Sequence[arb] | None = None
    stay: Sides | None = None

    def whole(self) -> Sides:
        """One box over all of it."""
        return self._near(hull(self.first, self.last), arb(1) / 4)

    def parts(self, count: int) -> list[Sides]:
        """Boxes over the parts ``[i / count, (i + 1) / count]``."""
        places = [between(self.first, self.last, ball(i) / count) for i in range(count + 1)]
        return [self._near(hull(*places[i : i + 2]), _rise(i, count)) for i in range(count)]

    def _near(self, box: Sides, rise: arb) -> Sides:
        """What may be off a box, ``s (1 - s)`` being at most so much."""
        low, high = box
        if self.bend is not None and self.rest is not None:
            off = [rise * b + r for b, r in zip(self.bend, self.rest, strict=True)]
            low, high = [a - o for a, o in zip(low, off, strict=True)], [b + o for b, o in zip(high, off, strict=True)]
        if self.stay is not None:
            low = [a.max(b) for a, b in zip(low, self.stay[0], strict=True)]
            high = [a.min(b) for a, b in zip(high, self.stay[1], strict=True)]
        return low, high


def _rise(i: int, count: int) -> arb:
    """The most that ``s (1 - s)`` is on ``[i / count, (i + 1) / count]``; it is highest in the middle."""
    if 2 * i < count < 2 * (i + 1):
        return arb(1) / 4
    nearest = i + 1 if 2 * (i + 1) <= count else i
    return arb(nearest * (count - nearest)) / count**2


def boxes_of(lower: np.ndarray, upper: np.ndarray) -> list[Sides]:
    """The boxes of rows ``(K+1, d)`` as they are."""
    return [(balls(low), balls(high)) for low, high in zip(lower, upper, strict=True)]


def hull(first: Sides, last: Sides) -> Sides:
    """One box around two."""
    return (
        [a.min(b) for a, b in zip(first[0], last[0], strict=True)],
        [a.max(b) for a, b in zip(first[1], last[1], strict=True)],
    )


def between(first: Sides, last: Sides, s: arb) -> Sides:
    """The box at a fraction of a line."""
    low, high = (on_line(a, b, s) for a, b in zip(first, last, strict=True))
    return low, high


def on_line(first: Sequence[arb], last: Sequence[arb], s: arb) -> list[arb]:
    """The point ``(1 - s) first + s last``."""
    return [(1 - s) * a + s * b for a, b in zip(first, last, strict=True)]
