"""A scene as a picture: what a vision-language planner sees."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sagemp_cli.scenes.frame import Frame
from sagemp_cli.scenes.objects import OBJECTS, PLAIN, PLATE, Array, Colour
from sagemp_cli.scenes.scene import Ball, Landmark, Obstacle, Scene

FLOOR: Colour = (250, 249, 246)
OUTSIDE: Colour = (90, 94, 102)
START: Colour = (20, 160, 60)
GOAL: Colour = (225, 30, 30)
DOT = 0.05
"""Radius of the dots at start and goal, in the picture's units."""

Image = NDArray[np.uint8]
Place = Sequence[float] | NDArray[np.floating]


def render(scene: Scene, frame: Frame, *, start: Place, goal: Place, height: int, dots: bool = True) -> Image:
    """The scene from above, ``(height, width, 3)``: floor, landmarks, obstacles; green dot at start, red one at goal.

    Edges are smoothed over one pixel, so a picture of a few dozen pixels, for a small network, shows the same as a
    large one. The same numbers give the same picture.

    Args:
        scene: two-dimensional.
        frame: which part of the picture is the workspace; gives the width.
        start: place of the green dot, metres.
        goal: place of the red dot, metres.
        height: pixels.
        dots: whether the dots are drawn.
    """
    width = max(1, round(height * frame.aspect))
    canvas = _Canvas(np.empty((height, width, 3), dtype=np.float32), frame)
    canvas.pixels[:] = OUTSIDE
    low, high = frame.to_image(np.array(frame.workspace))
    canvas.rectangle(low, high, FLOOR)
    for thing in (*scene.landmarks, *scene.obstacles):
        _draw(canvas, thing, frame)
    if dots:
        for place, colour in ((start, START), (goal, GOAL)):
            canvas.disc(frame.to_image(np.asarray(place[:2], dtype=np.float64)).tolist(), DOT, colour)
    return np.rint(canvas.pixels).astype(np.uint8)


def png_bytes(image: Image) -> bytes:
    """A picture ``(height, width, 3)`` as a PNG file; equal pictures give equal bytes."""
    height, width, _ = image.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), image.reshape(height, -1)], axis=1)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows.tobytes(), 6)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


class _Canvas:
    """Pixels to paint on, addressed in the picture's coordinates."""

    def __init__(self, pixels: Array, frame: Frame) -> None:
        self.pixels = pixels
        height, width, _ = pixels.shape
        self.unit = (frame.x[1] - frame.x[0]) / width  # of one pixel
        self.x = (frame.x[0] + (np.arange(width) + 0.5) * self.unit).astype(np.float32)
        self.y = (frame.y[1] - (np.arange(height) + 0.5) * (frame.y[1] - frame.y[0]) / height).astype(np.float32)

    def window(self, low: Sequence[float], high: Sequence[float]) -> tuple[slice, slice]:
        """Rows and columns that a shape within these corners can touch."""
        columns = np.searchsorted(self.x, [low[0] - self.unit, high[0] + self.unit])
        rows = np.searchsorted(-self.y, [-high[1] - self.unit, -low[1] + self.unit])
        return slice(*rows), slice(*columns)

    def paint(self, where: tuple[slice, slice], distance: Array, colour: Colour) -> None:
        """Blend a colour in where a signed distance is negative, over one pixel's width at its edge."""
        share = np.clip(0.5 - distance / self.unit, 0.0, 1.0)[..., None]
        part = self.pixels[where]
        part += share * (np.array(colour, dtype=np.float32) - part)

    def rectangle(self, low: Sequence[float], high: Sequence[float], colour: Colour) -> None:
        where = self.window(low, high)
        x, y = self.x[where[1]][None, :], self.y[where[0]][:, None]
        inside = np.maximum(np.maximum(low[0] - x, x - high[0]), np.maximum(low[1] - y, y - high[1]))
        self.paint(where, inside.astype(np.float32), colour)

    def disc(self, center: Sequence[float], radius: float, colour: Colour) -> None:
        where = self.window([c - radius for c in center], [c + radius for c in center])
        x, y = self.x[where[1]][None, :] - np.float32(center[0]), self.y[where[0]][:, None] - np.float32(center[1])
        self.paint(where, np.hypot(x, y) - np.float32(radius), colour)

    def drawing(self, name: str, center: Sequence[float], radius: float) -> None:
        where = self.window([c - radius for c in center], [c + radius for c in center])
        u = (self.x[where[1]][None, :] - np.float32(center[0])) / np.float32(radius)
        v = (self.y[where[0]][:, None] - np.float32(center[1])) / np.float32(radius)
        u, v = np.broadcast_arrays(u, v)
        for layer in OBJECTS[name]:
            self.paint(where, layer.shape(u, v) * np.float32(radius), layer.colour)


def _draw(canvas: _Canvas, thing: Obstacle | Landmark, frame: Frame) -> None:
    if isinstance(thing, Ball | Landmark):
        center, radius = frame.to_image(np.array(thing.center)).tolist(), thing.radius / frame.scale
        canvas.disc(center, radius, PLATE if thing.object else PLAIN)
    else:
        low, high = frame.to_image(np.array([thing.lower, thing.upper]))
        canvas.rectangle(low, high, PLATE if thing.object else PLAIN)
        center, radius = (0.5 * (low + high)).tolist(), 0.5 * float((high - low).min())
    if thing.object:
        canvas.drawing(thing.object, center, radius)
