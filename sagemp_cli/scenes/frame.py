"""Image coordinates: where a place of the workspace is in the picture that a planner is shown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sagemp_cli.errors import ConfigError
from sagemp_cli.sets import Box

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Frame:
    """A picture whose axes run over ``x`` (left to right) and ``y`` (bottom to top); the workspace is centred in it.

    The workspace is scaled the same along both axes and as large as fits, so circles stay circles and a path's
    directions stay what they are; where the shapes differ the picture has margins.

    Attributes:
        workspace: lower and upper corner in metres, ``((x, y), (x, y))``.
        x: range of the picture's first coordinate.
        y: range of its second.
    """

    workspace: tuple[tuple[float, float], tuple[float, float]]
    x: tuple[float, float] = (-1.0, 1.0)
    y: tuple[float, float] = (-1.0, 1.0)

    @classmethod
    def of(cls, workspace: Box, x: tuple[float, float] = (-1.0, 1.0), y: tuple[float, float] = (-1.0, 1.0)) -> Frame:
        """The frame of a two-dimensional workspace.

        Raises:
            ConfigError: the workspace has another dimension or no finite area.
        """
        low, high = workspace.lower.tolist(), workspace.upper.tolist()
        area = [b - a for a, b in zip(low, high, strict=True)]
        if len(low) != 2 or not all(0 < side < float("inf") for side in area):
            raise ConfigError(f"only a bounded two-dimensional workspace can be drawn, found {low} to {high}")
        return cls(((low[0], low[1]), (high[0], high[1])), x, y)

    @property
    def scale(self) -> float:
        """Metres per unit of the picture's coordinates."""
        (a, b), (c, d) = self.workspace
        return max((c - a) / (self.x[1] - self.x[0]), (d - b) / (self.y[1] - self.y[0]))

    @property
    def aspect(self) -> float:
        """Width of the picture over its height."""
        return (self.x[1] - self.x[0]) / (self.y[1] - self.y[0])

    @property
    def _middles(self) -> tuple[Array, Array]:
        metres = 0.5 * (np.array(self.workspace[0]) + np.array(self.workspace[1]))
        return metres, 0.5 * np.array([self.x[0] + self.x[1], self.y[0] + self.y[1]])

    def to_image(self, places: Array) -> Array:
        """Coordinates in the picture ``(..., 2)`` of places in metres ``(..., 2)``."""
        metres, units = self._middles
        return (np.asarray(places, dtype=np.float64) - metres) / self.scale + units

    def to_workspace(self, points: Array) -> Array:
        """Places in metres ``(..., 2)`` of coordinates in the picture ``(..., 2)``."""
        metres, units = self._middles
        return (np.asarray(points, dtype=np.float64) - units) * self.scale + metres
