"""The safe set: that stored tubes keep clear of obstacles, stay in the workspace and end in the goal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sagemp_cli.checker.balls import Unproved, arb, ball, number


@dataclass(frozen=True)
class SafeSet:
    """What the config says, as float64 numbers.

    Attributes:
        workspace: lower and upper corner over the position.
        balls: name, centre and radius; blocks: name, lower and upper corner. Closed sets.
        order: names of the constraints: the workspace, then the obstacles as the config lists them.
        goal: lower and upper corner over the state, infinite where there is no face.
    """

    workspace: tuple[list[float], list[float]]
    obstacles: tuple[tuple[str, str, list[float], Any], ...]
    goal: tuple[list[float], list[float]]

    @classmethod
    def of(cls, scene: Mapping[str, Any]) -> SafeSet:
        """From the config's ``scene`` section."""

        def box(part: Mapping[str, Any], *more: str) -> tuple[list[float], list[float]]:
            require_known("scene", part, "lower", "upper", *more)
            lower, upper = [number(v) for v in part["lower"]], [number(v) for v in part["upper"]]
            if not all(a <= b for a, b in zip(lower, upper, strict=True)):  # an obstacle that nothing can touch
                raise Unproved("the scene has a box whose corners are the wrong way round")
            return lower, upper

        # Landmarks and what an obstacle looks like are for planners: nothing is proved of them.
        require_known("scene", scene, "workspace", "obstacles", "goal", "name", "description", "landmarks")
        obstacles = []
        for i, item in enumerate(scene["obstacles"]):
            name = str(item.get("name", f"obstacle {i}"))
            if item["kind"] == "ball":
                require_known("scene", item, "kind", "name", "object", "center", "radius")
                center, radius = [number(v) for v in item["center"]], number(item["radius"])
                if not radius >= 0:
                    raise Unproved(f"the radius of obstacle '{name}' is {radius}")
                obstacles.append((name, "ball", center, radius))
            elif item["kind"] == "block":
                obstacles.append((name, "block", *box(item, "kind", "name", "object")))
            else:
                raise Unproved(f"obstacle '{name}' is of unknown kind '{item['kind']}'")
        return cls(box(scene["workspace"]), tuple(obstacles), box(scene["goal"]))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the constraints."""
        return ("workspace", *(o[0] for o in self.obstacles))

    def clearances(self, lower: np.ndarray, upper: np.ndarray) -> list[arb]:
        """Of position boxes ``(rows, d)``: the least distance to each constraint (to a block: the largest gap)."""
        return [
            _least([_inside(low, high, self.workspace) for low, high in zip(lower, upper, strict=True)]),
            *(_least([_apart(low, high, o) for low, high in zip(lower, upper, strict=True)]) for o in self.obstacles),
        ]

    def goal_margins(self, lower: np.ndarray, upper: np.ndarray) -> list[arb | None]:
        """Of a state box: how far it is inside each goal face pair, negative outside; None where there is no face."""
        margins: list[arb | None] = []
        for a, b, low, high in zip(lower, upper, *self.goal, strict=True):
            sides = [] if low == -np.inf else [ball(a) - ball(low)]
            sides += [] if high == np.inf else [ball(high) - ball(b)]
            margins.append(_least(sides) if sides else None)
        return margins


def require_known(where: str, part: Mapping[str, Any], *keys: str) -> None:
    """Refuse a section of the config that says more than is understood."""
    if not set(part) <= set(keys):
        raise Unproved(f"the {where} says '{min(set(part) - set(keys))}', which is not understood")


def _least(values: list[arb]) -> arb:
    out = values[0]
    for v in values[1:]:
        out = out.min(v)
    return out


def _inside(lower: np.ndarray, upper: np.ndarray, box: tuple[list[float], list[float]]) -> arb:
    low, high = box
    if len(low) != len(lower) or len(high) != len(upper):
        raise Unproved("the workspace has the wrong number of dimensions")
    sides = [ball(a) - ball(c) for a, c in zip(lower, low, strict=True) if c != -np.inf]
    sides += [ball(c) - ball(b) for b, c in zip(upper, high, strict=True) if c != np.inf]
    return _least(sides) if sides else arb("inf")


def _apart(lower: np.ndarray, upper: np.ndarray, obstacle: tuple[str, str, list[float], Any]) -> arb:
    _, kind, first, second = obstacle
    if kind == "block":
        gaps = [
            (ball(c) - ball(b)).max(ball(a) - ball(d)) for a, b, c, d in zip(lower, upper, first, second, strict=True)
        ]
        return -_least([-g for g in gaps])
    total = arb(0)
    for a, b, c in zip(lower, upper, first, strict=True):
        total += (ball(a) - ball(c)).max(ball(c) - ball(b)).max(arb(0)) ** 2
    return total.sqrt() - ball(second)
