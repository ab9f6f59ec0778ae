"""Figures as PNG files, without matplotlib's global state: safe in threads, tests and on machines without a screen."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sagemp_cli.errors import ResourceError


def draw_beside(artifact: Path, draw: Callable[..., Figure], *artifacts: Any) -> Path:
    """Draw a figure of artifacts and save it as ``<artifact>.png`` beside the file that it shows."""
    return save_figure(draw(*artifacts), artifact.with_suffix(".png"))


def save_figure(figure: Figure, path: Path) -> Path:
    """Write a figure whole or not at all; an earlier one is replaced, for a figure can always be made again.

    Raises:
        ResourceError: the folder cannot be written or the disk is full.
    """
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        FigureCanvasAgg(figure)
        figure.savefig(temporary, format="png", metadata={"Software": "sagemp"})
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except OSError as e:
        raise ResourceError(f"{path}: cannot be written: {e.strerror or e}") from e
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
    return path
