"""The stand-in for a vision-language model that needs no service: a small network and a search on its maps."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from sagemp_cli.planners.vlm.lessons import answers_to
from sagemp_cli.planners.vlm.network import SceneReader
from sagemp_cli.planners.vlm.question import Question
from sagemp_cli.scenes.frame import Frame


@dataclass(frozen=True)
class Local:
    """A provider that answers with :class:`~sagemp_cli.planners.vlm.network.SceneReader`.

    Its answers are JSON text in the prompt's coordinates, as a service's are, and the same code reads and checks them.

    Attributes:
        reader: the trained network.
        temperature: strength of the random preference that makes answers differ.
    """

    reader: SceneReader
    temperature: float
    label = "stand-in (small local network), no vision-language model"

    def answers(self, questions: Sequence[Question], *, generator: torch.Generator) -> list[str]:
        """One answer per question."""
        rng = np.random.default_rng(int(torch.randint(2**62, (), generator=generator)))
        squares = [Frame(q.frame.workspace) for q in questions]
        asked = [
            (q.scene, square, q.text, square.to_image(q.start), square.to_image(q.goal))
            for q, square in zip(questions, squares, strict=True)
        ]
        found = answers_to(self.reader, asked, temperature=self.temperature, rng=rng)
        return [
            json.dumps({"waypoints": q.frame.to_image(square.to_workspace(points)).round(3).tolist()})
            for q, square, points in zip(questions, squares, found, strict=True)
        ]
