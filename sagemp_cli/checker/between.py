"""Where the position is between two samples, in balls: what a claim over the whole of every step is proved of.

Under forward Euler the robot moves along a straight line within a step. From a box at each sample follows one over each
part of a step: at ``s`` the position is in ``(1 - s) B_k + s B_{k+1}``, whose faces are linear in s, so that over
``[a, b]`` they are farthest at a or b.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sagemp_cli.checker.balls import arb, ball, balls

SEGMENTS, SAMPLES = "segments", "samples"
"""What a file may claim: that the safe set is kept over the whole of every step, or at the samples only."""
MOST_PARTS = 64

Sides = tuple[list[arb], list[arb]]
"""Lower and upper faces of a box."""


def samples_of(lower: np.ndarray, upper: np.ndarray) -> list[Sides]:
    """The boxes of rows ``(K+1, d)`` as they are."""
    return [(balls(low), balls(high)) for low, high in zip(lower, upper, strict=True)]


def whole_step(first: Sides, last: Sides) -> Sides:
    """One box over all of a step."""
    return _lowest(first[0], last[0]), _highest(first[1], last[1])


def parts_of_step(first: Sides, last: Sides, parts: int) -> list[Sides]:
    """Boxes over the parts ``[i / parts, (i + 1) / parts]`` of a step."""
    places = [between(first, last, ball(i) / parts) for i in range(parts + 1)]
    return [whole_step(a, b) for a, b in zip(places[:-1], places[1:], strict=True)]


def between(first: Sides, last: Sides, s: arb) -> Sides:
    """The box at a fraction of a step."""
    low, high = (on_line(a, b, s) for a, b in zip(first, last, strict=True))
    return low, high


def on_line(first: Sequence[arb], last: Sequence[arb], s: arb) -> list[arb]:
    """The point ``(1 - s) first + s last``."""
    return [(1 - s) * a + s * b for a, b in zip(first, last, strict=True)]


def _lowest(first: Sequence[arb], last: Sequence[arb]) -> list[arb]:
    return [a.min(b) for a, b in zip(first, last, strict=True)]


def _highest(first: Sequence[arb], last: Sequence[arb]) -> list[arb]:
    return [a.max(b) for a, b in zip(first, last, strict=True)]
