"""The paper's prompts as templates: text files, with numbers put in at the paper's own places."""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from pathlib import Path

from sagemp_cli.config.folders import resource_folder
from sagemp_cli.errors import ConfigError, did_you_mean

AXES = {"blue_circles": ((-1.0, 1.0), (-1.0, 0.0))}
"""Ranges of the image's axes (x, y) that a prompt speaks of, where they are not -1 to 1."""

_PLACES = re.compile(r"\[current start\]|\[goal\]|\{(?:start|goal)_np\[([01])\]:\.2f\}|\{\{|\}\}")


def axes_of(prompt: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """The ranges of the image's axes that a prompt speaks of."""
    return AXES.get(prompt, ((-1.0, 1.0), (-1.0, 1.0)))


@functools.cache
def template(prompt: str) -> str:
    """The text of a prompt of ``data/prompts``, by its name, or of any text file, by its path.

    Raises:
        ConfigError: there is no such prompt or the file is no text.
    """
    folder = resource_folder("data") / "prompts"
    path = folder / f"{prompt}.txt" if "/" not in prompt and not prompt.endswith(".txt") else Path(prompt)
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        known = sorted(p.stem for p in folder.glob("*.txt"))
        raise ConfigError(
            f"planner.prompt '{prompt}': no such prompt{did_you_mean(prompt, known)}; known: {', '.join(known)}"
        ) from None


def fill(text: str, *, start: Sequence[float], goal: Sequence[float]) -> str:
    """A template with start and goal (image coordinates, two decimals) at the paper's places; nothing is evaluated."""
    values = {"start": [f"{v:.2f}" for v in start[:2]], "goal": [f"{v:.2f}" for v in goal[:2]]}

    def put(match: re.Match[str]) -> str:
        place = match.group()
        if place in ("{{", "}}"):
            return place[0]
        pair = values["start" if "start" in place else "goal"]
        return f"[{pair[0]}, {pair[1]}]" if place.startswith("[") else pair[int(match.group(1))]

    return _PLACES.sub(put, text)
