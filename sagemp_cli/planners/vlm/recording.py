"""Recorded answers: the file that holds them, and a provider that draws from them in place of a model."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import from_json

from sagemp_cli.errors import UsageError
from sagemp_cli.planners.vlm.question import Question
from sagemp_cli.storage.atomic import write_whole

LARGEST_FILE = 2**24
"""Bytes of a recording that are read."""
MOST_FILES = 10_000
"""Recordings of a folder, at most."""


@dataclass(frozen=True)
class Recording:
    """Answers of one model to one prompt.

    Attributes:
        answers: texts, untrusted.
        model: that gave them, if it is known.
        date: day on which it did, as in 2026-11-28.
        prompt_hash: SHA-256 of the prompt's template, as in :class:`~sagemp_cli.planners.vlm.question.Question`.
    """

    answers: tuple[str, ...]
    model: str | None = None
    date: str | None = None
    prompt_hash: str | None = None


class _File(BaseModel):
    """What a recording's JSON may be; names are such as may be shown in a terminal and in a figure."""

    model_config = ConfigDict(strict=True, extra="forbid")
    answers: Annotated[list[str], Field(min_length=1)]
    model: Annotated[str | None, Field(pattern=r"^[A-Za-z0-9._:/@ -]{1,100}$")] = None
    date: Annotated[str | None, Field(pattern=r"^\d{4}-\d\d-\d\d$")] = None
    prompt_hash: Annotated[str | None, Field(pattern=r"^[0-9a-f]{64}$")] = None


def read_recording(path: Path) -> Recording:
    """The recording of a file, which may be anybody's.

    Raises:
        UsageError: it is missing, or no recording.
    """
    try:
        if not path.is_file() or path.stat().st_size > LARGEST_FILE:  # a pipe would be read for ever
            raise UsageError(f"{path}: a recording must be a file of at most {LARGEST_FILE} bytes")
        found = _File.model_validate(from_json(path.read_bytes()))  # which has a limit of its own on depth
    except OSError as e:
        raise UsageError(f"{path}: cannot be read ({e.strerror})") from None
    except ValidationError:
        raise UsageError(
            f'{path}: a recording must hold {{"answers": [text, ...]}} with at least one text, '
            "and may hold model, date (2026-11-28) and prompt_hash"
        ) from None
    except (ValueError, RecursionError):
        raise UsageError(f"{path}: a recording must be JSON") from None
    return Recording(tuple(found.answers), found.model, found.date, found.prompt_hash)


def write_recording(path: Path, recording: Recording) -> None:
    """Write a recording, whole or not at all; one of that name is replaced."""
    write_whole(path, json.dumps(asdict(recording), indent=1).encode(), overwrite=True)


@dataclass(frozen=True)
class Replay:
    """A provider that draws from recorded answers, with replacement.

    It looks at no picture: the answers were given to one prompt, scene and start. Of the prompt it looks at the
    template, if the recording says to which it belongs.

    Attributes:
        path: of a recording, or of a folder of them, such as a service's cache.
    """

    path: Path

    @property
    def label(self) -> str:
        """What answered, and when, for figures.

        Raises:
            UsageError: there are no recorded answers.
        """
        recordings = self._recordings()
        models = sorted({r.model for r in recordings if r.model is not None})
        dates = sorted({r.date for r in recordings if r.date is not None})
        about = ", ".join([*models[:3], *dates[:1]])
        return f"replay of {self.path.name}" + (f" ({about})" if about else "")

    def answers(self, questions: Sequence[Question], *, generator: torch.Generator) -> list[str]:
        """One recorded answer per question.

        Raises:
            UsageError: there are no recorded answers, or they are to another prompt.
        """
        recordings = self._recordings()
        asked = {question.prompt_hash for question in questions}
        if any(r.prompt_hash is not None and {r.prompt_hash} != asked for r in recordings):
            raise UsageError(f"{self.path}: its answers were given to another prompt than planner.prompt")
        texts = [answer for recording in recordings for answer in recording.answers]
        return [texts[i] for i in torch.randint(len(texts), (len(questions),), generator=generator).tolist()]

    def _recordings(self) -> list[Recording]:
        if not self.path.is_dir():
            return [read_recording(self.path)]
        paths = sorted(self.path.glob("*.json"))
        if not 0 < len(paths) <= MOST_FILES:
            raise UsageError(f"{self.path}: found {len(paths)} recordings (*.json), 1 to {MOST_FILES} are allowed")
        return [read_recording(path) for path in paths]
