"""What things in a scene look like from above: a plate with a small drawing of the thing on it.

A drawing is a stack of coloured shapes in coordinates where the thing's disc has radius 1. A shape is a function
that gives a signed distance (negative inside), so that a drawing looks the same at every resolution.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
Colour = tuple[int, int, int]
Shape = Callable[[Array, Array], Array]


@dataclass(frozen=True)
class Layer:
    """One shape in one colour."""

    colour: Colour
    shape: Shape


def _disc(x: float, y: float, radius: float) -> Shape:
    return lambda u, v: np.hypot(u - x, v - y) - np.float32(radius)


def _bar(x: float, y: float, half_width: float, half_height: float) -> Shape:
    return lambda u, v: np.maximum(np.abs(u - x) - half_width, np.abs(v - y) - half_height)


def _both(*shapes: Shape) -> Shape:
    return lambda u, v: np.maximum.reduce([shape(u, v) for shape in shapes])


def _without(shape: Shape, hole: Shape) -> Shape:
    return lambda u, v: np.maximum(shape(u, v), -hole(u, v))


def _above(y: float) -> Shape:
    return lambda u, v: y - v


def _below(y: float) -> Shape:
    return lambda u, v: v - y


def _wedge(u: Array, v: Array) -> Array:
    """A triangle that points down."""
    return np.maximum.reduce([v - 0.5, 0.85 * np.abs(u) - 0.52 * (v + 0.75)])


PLATE: Colour = (226, 226, 220)
PLAIN: Colour = (38, 84, 200)
"""Colour of an obstacle without a drawing: a plain blue shape, as one of the paper's prompts calls them."""

OBJECTS: dict[str, tuple[Layer, ...]] = {
    "burger": (
        Layer((222, 150, 60), _both(_disc(0, -0.05, 0.72), _above(0.12))),
        Layer((70, 165, 50), _bar(0, 0.05, 0.78, 0.1)),
        Layer((92, 48, 24), _bar(0, -0.14, 0.7, 0.12)),
        Layer((222, 150, 60), _both(_disc(0, 0.0, 0.72), _below(-0.26))),
    ),
    "apple": (
        Layer((200, 22, 40), _disc(-0.2, -0.1, 0.5)),
        Layer((200, 22, 40), _disc(0.2, -0.1, 0.5)),
        Layer((96, 60, 30), _bar(0, 0.5, 0.06, 0.24)),
        Layer((60, 150, 50), _disc(0.24, 0.58, 0.17)),
    ),
    "banana": (Layer((246, 212, 40), _without(_disc(0, 0.1, 0.78), _disc(0.12, 0.48, 0.74))),),
    "orange": (
        Layer((244, 130, 20), _disc(0, 0, 0.68)),
        Layer((250, 176, 84), _disc(0, 0, 0.5)),
        Layer((244, 130, 20), _bar(0, 0, 0.5, 0.05)),
        Layer((244, 130, 20), _bar(0, 0, 0.05, 0.5)),
    ),
    "pizza": (
        Layer((244, 204, 90), _wedge),
        Layer((176, 110, 50), _bar(0, 0.5, 0.78, 0.12)),
        Layer((186, 40, 30), _disc(-0.2, 0.18, 0.15)),
        Layer((186, 40, 30), _disc(0.24, 0.14, 0.15)),
        Layer((186, 40, 30), _disc(0.0, -0.22, 0.13)),
    ),
    "donut": (
        Layer((190, 130, 74), _without(_disc(0, 0, 0.74), _disc(0, 0, 0.24))),
        Layer((240, 130, 180), _without(_disc(0, 0, 0.62), _disc(0, 0, 0.34))),
    ),
    "cup": (
        Layer((110, 70, 150), _without(_disc(0.5, 0.0, 0.34), _disc(0.5, 0.0, 0.18))),
        Layer((110, 70, 150), _disc(-0.1, 0, 0.58)),
        Layer((60, 34, 20), _disc(-0.1, 0, 0.42)),
    ),
}
"""Drawings by the name of the thing; a scene's ``object`` keys are among these names."""
