"""Figures as PNG files, without matplotlib's global state: safe in threads, tests and on machines without a screen."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sagemp_cli.report.bounded_canvas import BoundedCanvas
from sagemp_cli.storage.atomic import write_whole


def draw_beside(artifact: Path, draw: Callable[..., Figure], *artifacts: Any) -> Path:
    """Draw a figure of artifacts and save it as ``<artifact>.png`` beside the file that it shows."""
    with _unworried():
        return save_figure(draw(*artifacts), artifact.with_suffix(".png"))


def _unworried() -> np.errstate:
    """Scaling somebody else's numbers to a picture may overflow: what is drawn is bounded all the same."""
    return np.errstate(over="ignore", invalid="ignore")


def save_figure(figure: Figure, path: Path) -> Path:
    """Write a figure whole or not at all; an earlier one is replaced, for a figure can always be made again.

    Raises:
        ResourceError: the folder cannot be written or the disk is full.
    """
    BoundedCanvas(figure)
    drawn = io.BytesIO()
    with _unworried():
        figure.savefig(drawn, format="png", metadata={"Software": "sagemp"})
    return write_whole(path, drawn.getvalue(), overwrite=True)
