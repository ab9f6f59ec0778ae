"""A canvas on which any numbers can be drawn: what lies far outside the picture is drawn as if it were nearer.

Agg, which rasterises the figures, is not made for coordinates like 1e300, which artifacts and plans of others may hold:
it walks along a dashed line for ever, or gives up. A point farther away than :data:`FAR` is moved towards the middle of
the picture, so that lines to it leave the picture in their own direction.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.path import Path
from matplotlib.transforms import IdentityTransform, Transform

FAR = 1e6
"""Pixels from the picture's middle; Agg's own numbers end at 8e6."""


class BoundedCanvas(FigureCanvasAgg):
    """Agg's canvas with a :class:`BoundedRenderer`."""

    _bounded: BoundedRenderer | None = None

    def get_renderer(self) -> BoundedRenderer:
        """The renderer of this figure's size."""
        width, height = self.get_width_height(physical=True)
        found = self._bounded
        if found is None or (found.width, found.height, found.dpi) != (width, height, self.figure.dpi):
            found = self._bounded = BoundedRenderer(width, height, self.figure.dpi)
        return found


class BoundedRenderer(RendererAgg):
    """Agg's renderer, given near points only."""

    def draw_path(self, gc: Any, path: Path, transform: Transform, rgbFace: Any = None) -> None:
        """See :class:`~matplotlib.backend_bases.RendererBase`."""
        near = self._near(path, transform)
        if near is None:
            super().draw_path(gc, path, transform, rgbFace)
        else:
            super().draw_path(gc, near, IdentityTransform(), rgbFace)

    def _update_methods(self) -> None:
        super()._update_methods()
        self._draw_collection = self.draw_path_collection  # Agg's own, which is no method of the class
        self.draw_path_collection = self._near_collection  # pyright: ignore[reportAttributeAccessIssue]  (other names)

    def _near_collection(
        self,
        gc: Any,
        master: Transform,
        paths: Any,
        transforms: Any,
        offsets: Any,
        to_pixels: Transform,
        *rest: Any,
        **more: Any,
    ) -> None:
        """Paths that are drawn in place are moved; of those that are drawn at offsets, such as markers, the offsets."""
        if not len(transforms):
            moved = [self._near(path, master) for path in paths]
            if any(path is not None for path in moved):
                pairs = zip(moved, paths, strict=True)
                paths = [master.transform_path(path) if near is None else near for near, path in pairs]
                master = IdentityTransform()
        points = to_pixels.transform(np.reshape(offsets, (-1, 2)))
        if self._far(points).any():
            offsets, to_pixels = self._moved(points), IdentityTransform()
        self._draw_collection(gc, master, paths, transforms, offsets, to_pixels, *rest, **more)

    def _near(self, path: Path, transform: Transform) -> Path | None:
        """A path in pixels with its far points moved; None if it has none."""
        with np.errstate(all="ignore"):
            points = transform.transform(path.vertices)
        return Path(self._moved(points), path.codes) if self._far(points).any() else None

    def _far(self, points: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            return np.hypot(points[:, 0] - self.width / 2, points[:, 1] - self.height / 2) > FAR

    def _moved(self, points: np.ndarray) -> np.ndarray:
        middle = np.array([self.width / 2, self.height / 2])
        with np.errstate(all="ignore"):
            away = points - middle
            largest = np.abs(away).max(-1, keepdims=True)  # first, or the length of 1e300 is infinite
            direction = away / np.where(largest > 0, largest, 1.0)
            direction /= np.hypot(direction[:, :1], direction[:, 1:])
            return np.where(self._far(points)[:, None], middle + FAR * direction, points)
