"""Recorded answers in place of a model."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from sagemp_cli.errors import UsageError
from sagemp_cli.planners.vlm.question import Question


@dataclass(frozen=True)
class Replay:
    """A provider that draws from the answers of a file ``{"answers": ["...", ...]}``, with replacement.

    It looks neither at text nor picture: the answers were given to one prompt, scene and start.

    Attributes:
        path: of the file.
    """

    path: Path

    @property
    def label(self) -> str:
        """What answers, for figures."""
        return f"replay of {self.path.name}"

    def answers(self, questions: Sequence[Question], *, generator: torch.Generator) -> list[str]:
        """One recorded answer per question.

        Raises:
            UsageError: the file is missing or holds no answers.
        """
        recorded = self._recorded()
        return [recorded[i] for i in torch.randint(len(recorded), (len(questions),), generator=generator).tolist()]

    def _recorded(self) -> list[str]:
        try:
            data = json.loads(self.path.read_text(encoding="utf-8"))
        except OSError as e:
            raise UsageError(f"planner.recording: cannot read {self.path} ({e.strerror})") from None
        except ValueError as e:
            raise UsageError(f"{self.path}: a recording must be JSON ({e})") from None
        answers = data.get("answers") if isinstance(data, dict) else None
        if not isinstance(answers, list) or not answers or not all(isinstance(a, str) for a in answers):
            raise UsageError(f'{self.path}: a recording must hold {{"answers": [text, ...]}} with at least one text')
        return answers
