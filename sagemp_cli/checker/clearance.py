"""That stored tubes keep clear of obstacles, stay in the workspace and end in the goal, in balls."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from sagemp_cli.checker.balls import arb, ball
from sagemp_cli.checker.between import Line, Sides
from sagemp_cli.checker.scene import Corners, SafeSet


def clearances(safe: SafeSet, lines: Sequence[Line], parts: int) -> list[arb]:
    """The least distance of what is near some lines over the position to each constraint (to a block: the largest gap).

    Each line is looked at in so many parts.
    """
    distances: list[Callable[[Sides], arb]] = [] if safe.workspace is None else [partial(_inside, safe.workspace)]
    distances += [partial(_apart, obstacle) for obstacle in safe.obstacles]
    return [_least(lines, distance, parts) for distance in distances]


def _least(lines: Sequence[Line], distance: Callable[[Sides], arb], parts: int) -> arb:
    """The least distance over the parts of all lines.

    One box over a whole line is no farther away than its parts are: a line for which that is not below what is found
    already cannot change the least, and the nearest lines come first.
    """
    known = sorted(((distance(line.whole()), line) for line in lines), key=lambda pair: float(pair[0].mid()))
    found: arb | None = None
    for whole, line in known:
        if found is not None and whole >= found:
            continue
        nearest = smallest([distance(box) for box in line.parts(parts)])
        found = nearest if found is None else found.min(nearest)
    assert found is not None
    return found


def goal_margins(safe: SafeSet, lower: np.ndarray, upper: np.ndarray) -> list[arb | None]:
    """Of a state box: how far it is inside each goal face pair, negative outside; None where there is no face."""
    if safe.goal is None:
        return [None] * len(lower)
    margins: list[arb | None] = []
    for a, b, low, high in zip(lower, upper, *safe.goal, strict=True):
        sides = [] if low == -np.inf else [ball(a) - ball(low)]
        sides += [] if high == np.inf else [ball(high) - ball(b)]
        margins.append(smallest(sides) if sides else None)
    return margins


def smallest(values: list[arb]) -> arb:
    """The least of several."""
    out = values[0]
    for v in values[1:]:
        out = out.min(v)
    return out


def _inside(workspace: Corners, box: Sides) -> arb:
    low, high = workspace
    sides = [a - ball(c) for a, c in zip(box[0], low, strict=True) if c != -np.inf]
    sides += [ball(c) - b for b, c in zip(box[1], high, strict=True) if c != np.inf]
    return smallest(sides) if sides else arb("inf")


def _apart(obstacle: tuple[str, str, list[float], Any], box: Sides) -> arb:
    _, kind, first, second = obstacle
    if kind == "block":
        gaps = [(ball(c) - b).max(a - ball(d)) for a, b, c, d in zip(*box, first, second, strict=True)]
        return -smallest([-g for g in gaps])
    total = arb(0)
    for a, b, c in zip(*box, first, strict=True):
        total += (a - ball(c)).max(ball(c) - b).max(arb(0)) ** 2
    return total.sqrt() - ball(second)
