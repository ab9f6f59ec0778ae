"""Workspace, obstacles and goal: the safe set of the paper, with exact or outward-rounded box tests.

Beside them a scene may name landmarks, which are seen and spoken of but occupy nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sagemp_cli.errors import ConfigError, did_you_mean
from sagemp_cli.scenes.objects import OBJECTS
from sagemp_cli.scenes.segments import along, deepest
from sagemp_cli.sets import Box, round_down, round_up


@dataclass(frozen=True)
class Ball:
    """A disc (2-D) or sphere (3-D): ``|p - center|_2 <= radius`` is occupied. Closed form, never a polygon."""

    center: tuple[float, ...]
    radius: float
    name: str = "ball"
    object: str = ""
    """What it is drawn as, one of :data:`~sagemp_cli.scenes.objects.OBJECTS`; empty: a plain shape."""

    def signed_distance(self, p: Tensor) -> Tensor:
        """Distance of points ``(..., d)`` to the surface, negative inside (round to nearest)."""
        return torch.linalg.vector_norm(p - torch.tensor(self.center, dtype=p.dtype), dim=-1) - self.radius

    def nearest(self, path: Tensor) -> Tensor:
        """Where in [0, 1] each straight piece of paths ``(..., K+1, d)`` is nearest or deepest, ``(..., K)``."""
        first, way = path[..., :-1, :], path.diff(dim=-2)
        ahead = ((torch.tensor(self.center, dtype=path.dtype) - first) * way).sum(-1)
        return (ahead / way.square().sum(-1).clamp(min=_TINY)).clamp(0.0, 1.0)

    def clearance(self, box: Box) -> Tensor:
        """A lower bound on the distance between boxes ``(..., d)`` and the ball, rounded down; <= 0 may touch.

        Distance to the nearest point of the box (Arvo's test), each operation rounded towards zero.
        """
        c = torch.tensor(self.center, dtype=torch.float64)
        gap = round_down(torch.maximum(box.lower - c, c - box.upper)).clamp(min=0.0)
        square = round_down(gap * gap).clamp(min=0.0)
        total = square[..., 0]
        for i in range(1, square.shape[-1]):
            total = round_down(total + square[..., i]).clamp(min=0.0)
        return round_down(round_down(torch.sqrt(total)).clamp(min=0.0) - self.radius)

    def occupies(self, box: Box) -> Tensor:
        """Whether the ball certainly holds all of boxes ``(..., d)``: their farthest corners, rounded outwards."""
        c = torch.tensor(self.center, dtype=torch.float64)
        far = round_up(torch.maximum((box.lower - c).abs(), (box.upper - c).abs()))
        square = round_up(far * far)
        total = square[..., 0]
        for i in range(1, square.shape[-1]):
            total = round_up(total + square[..., i])
        return total <= round_down(torch.tensor(self.radius, dtype=torch.float64).square())


@dataclass(frozen=True)
class Block:
    """An axis-aligned rectangle or cuboid ``lower <= p <= upper``."""

    lower: tuple[float, ...]
    upper: tuple[float, ...]
    name: str = "block"
    object: str = ""
    """As for a :class:`Ball`."""

    def signed_distance(self, p: Tensor) -> Tensor:
        """Distance of points ``(..., d)`` to the surface, negative inside (round to nearest)."""
        low, high = (torch.tensor(v, dtype=p.dtype) for v in (self.lower, self.upper))
        gap = torch.maximum(low - p, p - high)
        return torch.linalg.vector_norm(gap.clamp(min=0.0), dim=-1) + gap.amax(-1).clamp(max=0.0)

    def nearest(self, path: Tensor) -> Tensor:
        """As of a :class:`Ball`."""
        low, high = (torch.tensor(v, dtype=path.dtype) for v in (self.lower, self.upper))
        return deepest(path, low, high, self.signed_distance)

    def clearance(self, box: Box) -> Tensor:
        """A lower bound on the largest per-axis gap between boxes and the block, rounded down; <= 0 may touch."""
        low, high = (torch.tensor(v, dtype=torch.float64) for v in (self.lower, self.upper))
        return round_down(torch.maximum(low - box.upper, box.lower - high).amax(-1))

    def occupies(self, box: Box) -> Tensor:
        """Whether the block holds the whole of boxes ``(..., d)``, exactly."""
        low, high = (torch.tensor(v, dtype=torch.float64) for v in (self.lower, self.upper))
        return ((low <= box.lower) & (box.upper <= high)).all(-1)


Obstacle = Ball | Block

_TINY = 1e-300


@dataclass(frozen=True)
class Landmark:
    """A named thing that a planner may be told of ("pass over the burger"): drawn, but no obstacle.

    Attributes:
        object: what it is, one of :data:`~sagemp_cli.scenes.objects.OBJECTS`.
        center: of its disc (or sphere), ``(d,)``.
        radius: of its disc.
        name: for figures.
    """

    object: str
    center: tuple[float, ...]
    radius: float
    name: str = "landmark"


@dataclass(frozen=True)
class Scene:
    """The safe set ``S`` (workspace minus obstacles, over positions) and the goal ``X_G`` (over states).

    Attributes:
        workspace: box of allowed positions, ``(d,)``.
        obstacles: occupied sets over positions.
        goal: box over the whole state ``(n,)``; dimensions that do not matter are infinite.
        landmarks: named things that occupy nothing; no proof speaks of them.
    """

    workspace: Box
    obstacles: tuple[Obstacle, ...]
    goal: Box
    landmarks: tuple[Landmark, ...] = ()

    def signed_distance(self, p: Tensor) -> Tensor:
        """Smallest distance of points ``(..., d)`` to any obstacle or the workspace's outside, negative if unsafe."""
        inside = torch.minimum(p - self.workspace.lower.to(p), self.workspace.upper.to(p) - p).amin(-1)
        return torch.stack([inside, *(o.signed_distance(p) for o in self.obstacles)], dim=-1).amin(-1)

    def signed_distance_along(self, path: Tensor) -> Tensor:
        """The same over the whole of each straight piece of paths ``(..., K+1, d)``, ``(..., K)``.

        The workspace is convex: a piece leaves it if and only if one of its ends does.
        """
        inside = torch.minimum(path - self.workspace.lower.to(path), self.workspace.upper.to(path) - path).amin(-1)
        least = torch.minimum(inside[..., :-1], inside[..., 1:])
        over = [o.signed_distance(along(path, o.nearest(path))) for o in self.obstacles]
        return torch.stack([least, *over], dim=-1).amin(-1)

    def clearances(self, box: Box) -> Tensor:
        """Lower bounds on the clearance of position boxes ``(..., d)``: last dimension is [workspace, obstacles...].

        A value > 0 proves that the box keeps clear (for the workspace: >= 0 would do; strict is used for both).
        """
        inside = round_down(torch.minimum(box.lower - self.workspace.lower, self.workspace.upper - box.upper).amin(-1))
        return torch.stack([inside, *(o.clearance(box) for o in self.obstacles)], dim=-1)

    @property
    def constraint_names(self) -> tuple[str, ...]:
        """Names along the last dimension of :meth:`clearances`."""
        return ("workspace", *(o.name for o in self.obstacles))


def _numbers(where: str, values: Any, size: int) -> tuple[float, ...]:
    if not isinstance(values, Sequence) or isinstance(values, str):
        raise ConfigError(f"{where} must be a list of numbers, found {values!r}")
    if any(isinstance(v, bool) or not (isinstance(v, int | float) or v in ("inf", "-inf")) for v in values):
        raise ConfigError(f"{where} must be a list of numbers, found {list(values)!r}")
    try:
        out = tuple(float(v) for v in values)
    except OverflowError:
        raise ConfigError(f"{where} holds a number that is too large") from None
    if len(out) != size:
        raise ConfigError(f"{where} needs {size} numbers, found {len(out)}")
    if any(v != v for v in out):
        raise ConfigError(f"{where} contains NaN")
    return out


def scene_from_mapping(data: Mapping[str, Any], *, state_dim: int, position_dim: int) -> Scene:
    """Build a scene from plain config data; every complaint names the key.

    Keys: ``workspace {lower, upper}``, ``obstacles`` (a list of ``{kind: ball, center, radius, name}`` or
    ``{kind: block, lower, upper, name}``, either with ``object``, what it is drawn as), ``goal {lower, upper}`` over
    the state (``-inf``/``inf`` allowed) and, optional, ``landmarks`` (a list of ``{object, center, radius, name}``).

    Raises:
        ConfigError: an unknown or missing key, or a value that is not what it should be.
    """
    _require_keys("scene", data, ("workspace", "obstacles", "goal"), ("name", "description", "landmarks"))
    for key in ("obstacles", "landmarks"):
        if not isinstance(data.get(key, []), Sequence) or isinstance(data.get(key), str):
            raise ConfigError(f"scene.{key} must be a list, found {data[key]!r}")
    landmarks = data.get("landmarks", [])
    return Scene(
        _box("scene.workspace", data["workspace"], position_dim),
        tuple(_obstacle(f"scene.obstacles[{i}]", item, i, position_dim) for i, item in enumerate(data["obstacles"])),
        _box("scene.goal", data["goal"], state_dim),
        tuple(_landmark(f"scene.landmarks[{i}]", item, i, position_dim) for i, item in enumerate(landmarks)),
    )


def _obstacle(where: str, item: Any, index: int, size: int) -> Obstacle:
    kind = item.get("kind") if isinstance(item, Mapping) else None
    if kind == "ball":
        _require_keys(where, item, ("kind", "center", "radius"), ("name", "object"))
        center, radius = _disc(where, item, size)
        return Ball(center, radius, str(item.get("name", f"obstacle {index}")), _object(where, item))
    if kind == "block":
        _require_keys(where, item, ("kind", "lower", "upper"), ("name", "object"))
        low, high = _numbers(f"{where}.lower", item["lower"], size), _numbers(f"{where}.upper", item["upper"], size)
        if any(a >= b for a, b in zip(low, high, strict=True)):
            raise ConfigError(f"{where}: lower must lie below upper, found {list(low)} and {list(high)}")
        return Block(low, high, str(item.get("name", f"obstacle {index}")), _object(where, item))
    raise ConfigError(f"{where}.kind must be 'ball' or 'block', found {kind!r}")


def _landmark(where: str, item: Any, index: int, size: int) -> Landmark:
    _require_keys(where, item, ("object", "center", "radius"), ("name",))
    center, radius = _disc(where, item, size)
    return Landmark(_object(where, item), center, radius, str(item.get("name", f"landmark {index}")))


def _disc(where: str, item: Mapping[str, Any], size: int) -> tuple[tuple[float, ...], float]:
    center = _finite(f"{where}.center", item["center"], size)
    (radius,) = _finite(f"{where}.radius", [item["radius"]], 1)
    if radius <= 0:
        raise ConfigError(f"{where}.radius must be a positive number, found {item['radius']!r}")
    return center, radius


def _object(where: str, item: Mapping[str, Any]) -> str:
    """What a thing is drawn as, empty where that is not said."""
    if "object" not in item:
        return ""
    if item["object"] not in OBJECTS:
        near = did_you_mean(str(item["object"]), OBJECTS)
        raise ConfigError(f"{where}.object: nothing is drawn as {item['object']!r}{near}; known: {', '.join(OBJECTS)}")
    return str(item["object"])


def _box(where: str, part: Any, size: int) -> Box:
    _require_keys(where, part, ("lower", "upper"))
    low, high = _numbers(f"{where}.lower", part["lower"], size), _numbers(f"{where}.upper", part["upper"], size)
    if any(a > b for a, b in zip(low, high, strict=True)):
        raise ConfigError(f"{where}: lower must not exceed upper, found {list(low)} and {list(high)}")
    return Box(torch.tensor(low, dtype=torch.float64), torch.tensor(high, dtype=torch.float64))


def _require_keys(where: str, data: Any, needed: Sequence[str], allowed: Sequence[str] = ()) -> None:
    if not isinstance(data, Mapping):
        raise ConfigError(f"{where} must be a mapping with {', '.join(needed)}, found {data!r}")
    for key in data:
        if key not in needed and key not in allowed:
            near = did_you_mean(str(key), (*needed, *allowed)) or f"; known: {', '.join((*needed, *allowed))}"
            raise ConfigError(f"{where}: unknown key '{key}'{near}")
    for key in needed:
        if key not in data:
            raise ConfigError(f"{where}: key '{key}' is missing")


def _finite(where: str, values: Any, size: int) -> tuple[float, ...]:
    numbers = _numbers(where, values, size)
    if any(abs(v) == float("inf") for v in numbers):
        raise ConfigError(f"{where} must be finite, found {values!r}")
    return numbers
