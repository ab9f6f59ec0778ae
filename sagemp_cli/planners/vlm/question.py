"""What a vision-language model is asked: a text and a picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sagemp_cli.scenes.frame import Frame
from sagemp_cli.scenes.render import png_bytes, render
from sagemp_cli.scenes.scene import Scene


@dataclass(frozen=True)
class Question:
    """One question.

    Attributes:
        text: the prompt with its numbers.
        prompt_hash: SHA-256 of the prompt's template, without numbers: what a recording is checked against.
        scene: what the picture shows.
        frame: the picture's coordinates, in which waypoints are answered.
        start: place of the start, metres ``(2,)``.
        goal: place of the goal, metres ``(2,)``.
    """

    text: str
    prompt_hash: str
    scene: Scene
    frame: Frame
    start: NDArray[np.float64]
    goal: NDArray[np.float64]

    def png(self, height: int) -> bytes:
        """The picture as a PNG file of so many rows."""
        return png_bytes(render(self.scene, self.frame, start=self.start, goal=self.goal, height=height))
