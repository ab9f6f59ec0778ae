"""The safe set of a certificate, as its config says it: workspace, obstacles, goal; each may be missing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sagemp_cli.checker.unproved import Unproved

Corners = tuple[list[float], list[float]]


@dataclass(frozen=True)
class SafeSet:
    """What the config says, as float64 numbers.

    Attributes:
        workspace: lower and upper corner over the position; None if there is none.
        obstacles: name, kind, and of a ball centre and radius, of a block lower and upper corner. Closed sets.
        goal: lower and upper corner over the state, infinite where there is no face; None if there is none.
    """

    workspace: Corners | None
    obstacles: tuple[tuple[str, str, list[float], Any], ...]
    goal: Corners | None

    @classmethod
    def of(cls, scene: Mapping[str, Any] | None) -> SafeSet:
        """From the config's ``scene`` section, if it has one."""
        if scene is None:
            return cls(None, (), None)
        # Landmarks and what an obstacle looks like are for planners: nothing is proved of them.
        require_known("scene", scene, "workspace", "obstacles", "goal", "name", "description", "landmarks")
        workspace, goal = (
            _corners(scene[key]) if scene.get(key) is not None else None for key in ("workspace", "goal")
        )
        return cls(workspace, tuple(_obstacle(i, item) for i, item in enumerate(scene.get("obstacles", ()))), goal)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the constraints: the workspace, then the obstacles as the config lists them."""
        return (*(() if self.workspace is None else ("workspace",)), *(o[0] for o in self.obstacles))

    def require_sizes(self, positions: int, states: int) -> None:
        """Refuse a scene of other dimensions than the loop's."""
        sides = [v for o in self.obstacles for v in o[2:] if isinstance(v, list)] + list(self.workspace or ())
        if any(len(v) != positions for v in sides) or any(len(v) != states for v in self.goal or ()):
            raise Unproved(f"the scene does not have the dimensions of {positions} positions and {states} states")
        if self.names and not positions:
            raise Unproved("the scene has obstacles or a workspace, but no state is a position")


@dataclass(frozen=True)
class SetOfConfig:
    """X_I or W as the config says it: ``first +- second``, or between the two.

    Attributes:
        first, second: centre and radius, or lower and upper corner.
        around: whether they are centre and radius.
    """

    first: list[float]
    second: list[float]
    around: bool

    @classmethod
    def of(cls, where: str, section: Mapping[str, Any], size: int) -> SetOfConfig:
        """From ``start`` or ``disturbance``; a disturbance with a radius alone is around 0."""
        around = "radius" in section
        keys = ("center", "radius") if around else ("lower", "upper")
        require_known(where, section, *keys)
        given = (
            section if "center" in section or not around or where == "start" else {"center": [0.0] * size, **section}
        )
        first, second = ([number(v) for v in given[key]] for key in keys)
        if len(first) != size or len(second) != size:
            raise Unproved(f"the {where} has {len(first)} and {len(second)} numbers, {size} are needed")
        if not all(b >= (0 if around else a) for a, b in zip(first, second, strict=True)):
            raise Unproved(f"the {where} is a box whose corners are the wrong way round")
        return cls(first, second, around)

    def corners(self) -> Corners:
        """Lower and upper corner, rounded to nearest."""
        if not self.around:
            return self.first, self.second
        pairs = list(zip(self.first, self.second, strict=True))
        return [c - r for c, r in pairs], [c + r for c, r in pairs]


def _corners(part: Mapping[str, Any], *more: str) -> Corners:
    require_known("scene", part, "lower", "upper", *more)
    lower, upper = [number(v) for v in part["lower"]], [number(v) for v in part["upper"]]
    if not all(a <= b for a, b in zip(lower, upper, strict=True)):  # an obstacle that nothing can touch
        raise Unproved("the scene has a box whose corners are the wrong way round")
    return lower, upper


def _obstacle(i: int, item: Mapping[str, Any]) -> tuple[str, str, list[float], Any]:
    name = str(item.get("name", f"obstacle {i}"))
    if item["kind"] == "ball":
        require_known("scene", item, "kind", "name", "object", "center", "radius")
        center, radius = [number(v) for v in item["center"]], number(item["radius"])
        if not radius >= 0:
            raise Unproved(f"the radius of obstacle '{name}' is {radius}")
        return name, "ball", center, radius
    if item["kind"] == "block":
        return name, "block", *_corners(item, "kind", "name", "object")
    raise Unproved(f"obstacle '{name}' is of unknown kind '{item['kind']}'")


def require_known(where: str, part: Mapping[str, Any], *keys: str) -> None:
    """Refuse a section of the config that says more than is understood."""
    if not set(part) <= set(keys):
        raise Unproved(f"the {where} says '{min(set(part) - set(keys))}', which is not understood")


def number(value: Any) -> float:
    """A number of the config as float64.

    Raises:
        TypeError: a text, a truth value or anything else.
        OverflowError: a whole number that float64 cannot hold.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"a number is needed, found something of type {type(value).__name__}")
    return float(value)
