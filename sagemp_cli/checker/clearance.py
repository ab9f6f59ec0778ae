"""That stored tubes keep clear of obstacles, stay in the workspace and end in the goal, in balls."""

from __future__ import annotations

from typing import Any

import numpy as np

from sagemp_cli.checker.balls import arb, ball
from sagemp_cli.checker.scene import Corners, SafeSet


def clearances(safe: SafeSet, lower: np.ndarray, upper: np.ndarray) -> list[arb]:
    """Of position boxes ``(rows, d)``: the least distance to each constraint (to a block: the largest gap)."""
    boxes = list(zip(lower, upper, strict=True))
    found = [] if safe.workspace is None else [smallest([_inside(low, high, safe.workspace) for low, high in boxes])]
    return found + [smallest([_apart(low, high, o) for low, high in boxes]) for o in safe.obstacles]


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


def _inside(lower: np.ndarray, upper: np.ndarray, box: Corners) -> arb:
    low, high = box
    sides = [ball(a) - ball(c) for a, c in zip(lower, low, strict=True) if c != -np.inf]
    sides += [ball(c) - ball(b) for b, c in zip(upper, high, strict=True) if c != np.inf]
    return smallest(sides) if sides else arb("inf")


def _apart(lower: np.ndarray, upper: np.ndarray, obstacle: tuple[str, str, list[float], Any]) -> arb:
    _, kind, first, second = obstacle
    if kind == "block":
        gaps = [
            (ball(c) - ball(b)).max(ball(a) - ball(d)) for a, b, c, d in zip(lower, upper, first, second, strict=True)
        ]
        return -smallest([-g for g in gaps])
    total = arb(0)
    for a, b, c in zip(lower, upper, first, strict=True):
        total += (ball(a) - ball(c)).max(ball(c) - ball(b)).max(arb(0)) ** 2
    return total.sqrt() - ball(second)
