"""What a stage is told, and how it reads and writes the files of an experiment."""

from __future__ import annotations

import functools
import hashlib
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from sagemp_cli.config.composition import compose
from sagemp_cli.errors import ArtifactError, ConfigError
from sagemp_cli.pipeline.stage import stage_named
from sagemp_cli.progress import Progress, Silent
from sagemp_cli.reading.regular import is_there, sha256_if_there
from sagemp_cli.storage import Artifact, Header, Parent, read_artifact, sha256_of, write_artifact


@dataclass(frozen=True)
class StageContext:
    """What a stage is told: the config, where to read and write, and how to report.

    Attributes:
        config: resolved config.
        folder: folder of the experiment's artifacts.
        overwrite: whether an existing output may be replaced.
        progress: where to report to.
        started: for the seconds in the header.
    """

    config: Mapping[str, Any]
    folder: Path
    overwrite: bool = False
    progress: Progress = field(default_factory=Silent)
    started: float = field(default_factory=time.monotonic)

    @classmethod
    def of(cls, config: Mapping[str, Any], **options: Any) -> StageContext:
        """The context of a config: its folder is ``<artifacts>/<name><effort.suffix>``."""
        return cls(config, Path(config["artifacts"]) / f"{config['name']}{config['effort']['suffix']}", **options)

    @property
    def seed(self) -> int:
        """Root seed."""
        return int(self.config["seed"])

    def generator(self, purpose: str) -> torch.Generator:
        """A random generator that depends on the root seed and the purpose only."""
        digest = hashlib.sha256(f"{self.seed}/{purpose}".encode()).digest()
        return torch.Generator().manual_seed(int.from_bytes(digest[:7], "big"))

    def owner(self, stage: str) -> StageContext:
        """The context in which a stage's file is made: this one, or that of the experiment named in ``sources``.

        The other experiment is run as it is in its own file: of this call's overrides it only gets seed, effort
        and artifacts.

        Raises:
            ConfigError: sources that lead back to where they started.
        """
        here, passed = self, [self.config["name"]]
        while (name := here.config["sources"].get(stage)) is not None:
            if name in passed:
                raise ConfigError(f"sources.{stage}: {' -> '.join([*passed, name])} goes in a circle")
            passed.append(name)
            shared = {key: here.config[key] for key in ("seed", "artifacts")}
            options = (f"effort={here.config['effort']['name']}", *(f"{k}={v}" for k, v in shared.items()))
            other = StageContext.of(_composed((f"experiment={name}", *options)))
            here = replace(here, config=other.config, folder=other.folder)
        return here

    def output_path(self, stage: str) -> Path:
        """Where a stage's output is, in this experiment's folder or in that of the one it comes from."""
        return self.owner(stage).folder / stage_named(stage).output

    def partial_folder(self, stage: str) -> Path:
        """Where a long stage keeps finished pieces until its output is written."""
        return self.folder / f".{stage_named(stage).role}.partial"

    def read(self, stage: str) -> Artifact[Any]:
        """Read another stage's output and check that it fits this config and its own parents.

        Raises:
            ArtifactError: missing (names the command that makes it), of another experiment, robot or dt,
                or made from a parent that has changed since.
        """
        owner = self.owner(stage)
        if owner is not self:
            artifact = owner.read(stage)
            if owner.config["horizon"] != self.config["horizon"]:
                raise ConfigError(
                    f"sources.{stage}: {owner.config['name']} has horizon {owner.config['horizon']}, "
                    f"{self.config['name']} has {self.config['horizon']}"
                )
            return artifact
        made_by, path = stage_named(stage), self.output_path(stage)
        if not is_there(path):
            raise ArtifactError(
                f"{path}: missing; make it with 'sagemp {stage} experiment={self.config['name']}'"
                f" (or 'sagemp run', which makes everything that is missing)"
            )
        artifact = read_artifact(path, made_by.record)
        different = made_by.difference(artifact.header.config, self.config)
        if different is not None:
            where, found, wanted = different
            raise ArtifactError(
                f"{path}: was made with {where}={found}, this config says {wanted}; "
                f"remake it with 'sagemp {stage} --overwrite' or drop the override"
            )
        for parent in artifact.header.parents:
            source = self.folder / parent.path
            # An input that is gone cannot contradict what was made from it.
            if sha256_if_there(source) not in (None, parent.sha256):
                raise ArtifactError(
                    f"{path}: was made from an earlier {source}, which has changed since; "
                    f"remake it with 'sagemp {stage} --overwrite'"
                )
        return artifact

    def parents(self, inputs: Sequence[Artifact[Any] | Parent]) -> tuple[Parent, ...]:
        """Artifacts and other files as the parents of what is made from them, in this experiment's folder."""
        return tuple(i if isinstance(i, Parent) else i.as_parent(i.path.stem, self.folder) for i in inputs)

    def source(self, role: str, path: Path) -> Parent:
        """A file that no stage made, as a parent of what is made from it."""
        return Parent(role, os.path.relpath(path, self.folder), sha256_of(path))

    def write(self, stage: str, record: Any, inputs: Sequence[Artifact[Any] | Parent] = ()) -> Path:
        """Write a stage's output with its provenance: the artifacts and other files that it was made from."""
        header = Header(
            stage=stage,
            experiment=str(self.config["name"]),
            config=self.config,
            seed=self.seed,
            parents=self.parents(inputs),
            seconds=time.monotonic() - self.started,
        )
        return write_artifact(self.output_path(stage), record, header, overwrite=self.overwrite)


@functools.cache
def _composed(overrides: tuple[str, ...]) -> dict[str, Any]:
    return compose(overrides)
