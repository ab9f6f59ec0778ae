"""Finished pieces of a long stage, kept until its output is written, so that an interrupted run resumes."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sagemp_cli import __version__
from sagemp_cli.errors import ArtifactError, ResourceError
from sagemp_cli.learning.checkpoint import Resumable
from sagemp_cli.pipeline.claim import Claim, remove_unused
from sagemp_cli.pipeline.context import StageContext
from sagemp_cli.pipeline.stage import stage_named
from sagemp_cli.reading.reader import read_arrays
from sagemp_cli.storage import Artifact, Parent

Inputs = Sequence[Artifact[Any] | Parent]


def work_identity(context: StageContext, stage: str, inputs: Inputs = (), *, without: Sequence[str] = ()) -> str:
    """A hash of everything that a stage's result depends on: its config sections, its inputs and the version.

    Args:
        context: gives the config.
        stage: name of the stage.
        inputs: artifacts and other files that it is made from.
        without: dotted keys that finished pieces do not depend on.
    """
    config = stage_named(stage).settings(context.config, without=without)
    data = [__version__, stage, config, sorted((p.role, p.sha256) for p in context.parents(inputs))]
    return hashlib.sha256(json.dumps(data, sort_keys=True, default=str).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class PartialResults:
    """Numbered pieces as NPZ files without pickles, in a folder that is named after the work's identity.

    Runs of the same work at the same time share them: a piece is the same whoever makes it.

    Attributes:
        claim: of ``<stage's partial folder>/<identity>``; pieces of other work beside it are removed, unless a run
            uses them.
    """

    claim: Claim

    @property
    def folder(self) -> Path:
        """Where the pieces are."""
        return self.claim.folder

    @classmethod
    def of(
        cls, context: StageContext, stage: str, inputs: Inputs = (), *, without: Sequence[str] = ()
    ) -> PartialResults:
        """Open the pieces of a stage, dropping those that a changed config or input has made stale."""
        identity = work_identity(context, stage, inputs, without=without)
        return cls(_claimed(context, stage, identity))

    @property
    def finished(self) -> set[int]:
        """Numbers of the finished pieces."""
        return {int(p.stem) for p in self.folder.glob("*.npz") if p.stem.isdigit()}

    def save(self, index: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Keep a finished piece; it is there wholly or not at all."""
        temporary = self.folder / f"{index:06d}.{os.getpid()}.tmp"
        try:
            with temporary.open("wb") as f:
                np.savez(f, **arrays)  # pyright: ignore[reportArgumentType]  (declared with a flag beside the arrays)
            os.replace(temporary, self._path(index))
        except OSError as e:
            temporary.unlink(missing_ok=True)
            raise ResourceError(f"{self.folder}: cannot be written: {e.strerror or e}") from e

    def load(self, index: int) -> dict[str, np.ndarray]:
        """Read a finished piece.

        Raises:
            ResourceError: it is damaged; it is deleted so that the next run makes it again.
        """
        path = self._path(index)
        try:
            return read_arrays(path)[1]
        except ArtifactError as e:
            path.unlink(missing_ok=True)
            why = str(e).removeprefix(f"{path}: ")
            raise ResourceError(
                f"{path}: damaged piece, deleted; run the stage again to make it anew ({why})"
            ) from None

    def remove(self) -> None:
        """Remove all pieces: the stage's output is written."""
        self.claim.remove()

    def _path(self, index: int) -> Path:
        return self.folder / f"{index:06d}.npz"


@dataclass(frozen=True)
class PartialFile:
    """The checkpoint of a training stage.

    Attributes:
        claim: of the folder that it is in; it is removed when the work that it belongs to has changed.
        identity: what the checkpoint must say.
    """

    claim: Claim
    identity: str

    @property
    def resumable(self) -> Resumable:
        """The same as a training is given it."""
        return Resumable(self.claim.folder / "checkpoint.h5", self.identity)

    @classmethod
    def of(cls, context: StageContext, stage: str, inputs: Inputs = ()) -> PartialFile:
        """Where the stage's checkpoint is; a checkpoint of other work beside it is removed."""
        identity = work_identity(context, stage, inputs)
        return cls(_claimed(context, stage, identity), identity)

    def remove(self) -> None:
        """Remove the checkpoint: the stage's output is written."""
        self.claim.remove()


def _claimed(context: StageContext, stage: str, identity: str) -> Claim:
    """Claim the folder of a stage's work until the stage ends, and remove those of other work that nobody uses."""
    parent = context.partial_folder(stage)
    claim = Claim(parent / identity)
    context.resources.callback(claim.release)
    try:
        for other in parent.iterdir():
            if other != claim.folder:
                remove_unused(other)
    except OSError as e:
        raise ResourceError(f"{parent}: cannot be written: {e.strerror or e}") from e
    return claim
