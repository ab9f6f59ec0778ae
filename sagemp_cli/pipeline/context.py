"""What a stage is told, and how it reads and writes the files of an experiment."""

from __future__ import annotations

import functools
import hashlib
import os
import shlex
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sagemp_cli.config.composition import compose, options_of
from sagemp_cli.errors import ArtifactError, ConfigError
from sagemp_cli.pipeline.stage import stage_named
from sagemp_cli.progress import Progress, Silent
from sagemp_cli.reading.regular import is_there, sha256_if_there
from sagemp_cli.storage import Artifact, Header, Parent, open_header, read_artifact, sha256_of, write_artifact

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class StageContext:
    """What a stage is told: the config, where to read and write, and how to report.

    Attributes:
        config: resolved config.
        folder: folder of the experiment's artifacts.
        overwrite: whether an existing output may be replaced.
        progress: where to report to.
        started: for the seconds in the header.
        typed: the overrides of the call as they were typed, for commands in messages; None if nobody typed any.
        resources: what is given back when the stage ends, however it ends.
    """

    config: Mapping[str, Any]
    folder: Path
    overwrite: bool = False
    progress: Progress = field(default_factory=Silent)
    started: float = field(default_factory=time.monotonic)
    typed: tuple[str, ...] | None = None
    resources: ExitStack = field(default_factory=ExitStack)

    @classmethod
    def of(cls, config: Mapping[str, Any], **options: Any) -> StageContext:
        """The context of a config: its folder is ``<artifacts>/<name><effort.suffix>``.

        Raises:
            ConfigError: these are not names of folders.
        """
        _require_folder("artifacts", str(config["artifacts"]))
        return cls(
            config, Path(config["artifacts"]) / _name(f"{config['name']}{config['effort']['suffix']}"), **options
        )

    def generator(self, purpose: str) -> torch.Generator:
        """A generator that depends on the purpose (``stage`` or ``stage: what for``) and that stage's seed only."""
        import torch  # here, for 'status', which draws nothing, is to come at once

        seed = stage_named(purpose.partition(":")[0]).seed_in(self.config)
        digest = hashlib.sha256(f"{seed}/{purpose}".encode()).digest()
        return torch.Generator().manual_seed(int.from_bytes(digest[:7], "big"))

    def command(self, stage: str, *flags: str) -> str:
        """A stage's command as it has to be typed to act on this context's files."""
        said = (f"experiment={self.config['name']}",) if self.typed is None else self.typed
        return " ".join(["sagemp", stage, *map(shlex.quote, said), *flags])

    def owner(self, stage: str) -> StageContext:
        """The context in which a stage's file is made: this one, or that of what ``sources`` names.

        Another experiment is run as it is in its own file: of this call's overrides it only gets seed, effort
        and artifacts. A run with a name of its own is as the header of its file says.

        Raises:
            ConfigError: sources that lead back to where they started, or that name nothing.
            ArtifactError: the file of a run with a name of its own is not an artifact.
        """
        here, passed = self, [self.config["name"]]
        while (name := here.config["sources"].get(stage)) is not None:
            if name in passed:
                raise ConfigError(f"sources.{stage}: {' -> '.join([*passed, name])} goes in a circle")
            passed.append(name)
            here = here._of_experiment(name) if name in options_of("experiment") else here._of_named_run(name, stage)
        return here

    def _of_experiment(self, name: str) -> StageContext:
        shared = {key: self.config[key] for key in ("seed", "artifacts")}
        options = (f"effort={self.config['effort']['name']}", *(f"{k}={v}" for k, v in shared.items()))
        other = StageContext.of(_composed((f"experiment={name}", *options)))
        kept = [o for o in self.typed or () if o.partition("=")[0] in ("effort", "seed", "artifacts")]
        return replace(self, config=other.config, folder=other.folder, typed=(f"experiment={name}", *kept))

    def _of_named_run(self, name: str, stage: str) -> StageContext:
        path = named_run_file(self.config, name, stage)
        if path is None:
            raise ConfigError(f"sources.{stage}: no experiment '{name}', and no file of a run of that name")
        config = {**open_header(path)[1].config, "artifacts": self.config["artifacts"]}
        # What was typed to make it is not known, its name is.
        return replace(self, config=config, folder=path.parent, typed=(f"name={name}", "..."))

    def output_path(self, stage: str) -> Path:
        """Where a stage's output is, in this experiment's folder or in that of the one it comes from."""
        owner = self.owner(stage)
        return owner.folder / stage_named(stage).output_in(owner.config)

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
                f"{path}: missing; make it with '{self.command(stage)}'"
                f" (or '{self.command('run')}', which makes everything that is missing)"
            )
        artifact = read_artifact(path, made_by.record)
        sampled = (made_by.seed,) if made_by.seed != "seed" else ()
        different = made_by.difference(artifact.header.config, self.config, without=sampled)
        if different is not None:
            where, found, wanted = different
            raise ArtifactError(
                f"{path}: was made with {where}={found}, this config says {wanted}; remake it with "
                f"'{self.command(stage, '--overwrite')}', drop the override{self.as_source(stage, where)}"
            )
        for parent in artifact.header.parents:
            source = self.folder / parent.path
            # An input that is gone cannot contradict what was made from it.
            if sha256_if_there(source) not in (None, parent.sha256):
                raise ArtifactError(
                    f"{path}: was made from an earlier {source}, which has changed since; "
                    f"remake it with '{self.command(stage, '--overwrite')}'"
                )
        return artifact

    def inputs_of(self, stage: str) -> dict[str, Artifact[Any]]:
        """The files that a stage reads under this config, by the stages that make them, see :meth:`read`."""
        return {name: self.read(name) for name in stage_named(stage).inputs_in(self.config)}

    def as_source(self, stage: str, key: str) -> str:
        """How trained files serve another problem as they are, as the end of a list of remedies; empty if they cannot.

        Args:
            stage: whose file does not fit.
            key: dotted key that it does not fit in.
        """
        name = str(self.config["name"])
        if not stage.startswith("train-") or key in ("name", "horizon") or key.startswith("dynamics."):
            return ""
        if name not in options_of("experiment"):
            return ""
        own = [s for s in ("train-dynamics", "train-planner", "train-tracker") if stage_named(s).applies(self.config)]
        return ", or use it as it is in a run of another name: name=NAME " + " ".join(
            f"sources.{s}={name}" for s in own
        )

    def parents(self, inputs: Sequence[Artifact[Any] | Parent]) -> tuple[Parent, ...]:
        """Artifacts and other files as the parents of what is made from them, in this experiment's folder."""
        return tuple(i if isinstance(i, Parent) else i.as_parent(i.path.stem, self.folder) for i in inputs)

    def source(self, role: str, path: Path) -> Parent:
        """A file that no stage made, as a parent of what is made from it."""
        return Parent(role, os.path.relpath(path, self.folder), sha256_of(path))

    def write(self, stage: str, record: Any, inputs: Sequence[Artifact[Any] | Parent] = ()) -> Path:
        """Write a stage's output with its provenance: the artifacts and other files that it was made from, the seed."""
        header = Header(
            stage=stage,
            experiment=str(self.config["name"]),
            config=self.config,
            seed=stage_named(stage).seed_in(self.config),
            parents=self.parents(inputs),
            seconds=time.monotonic() - self.started,
        )
        path = write_artifact(self.output_path(stage), record, header, overwrite=self.overwrite)
        path.with_suffix(".png").unlink(missing_ok=True)  # of the file that is gone; its own is drawn next
        return path


_LONGEST_NAME = 100


def _name(text: str) -> str:
    """An experiment's name as that of a folder, which lies in the folder of artifacts whatever it says."""
    right = text[:1].isalnum() or text[:1] == "_"
    if not right or len(text) > _LONGEST_NAME or not all(c.isalnum() or c in "_-.+" for c in text):
        raise ConfigError(
            f"name (with effort.suffix) must be a folder's name: at most {_LONGEST_NAME} letters, digits and _ - . +, "
            f"a letter, digit or _ first; found {text!r}"
        )
    return text


def _require_folder(key: str, text: str) -> None:
    if not text.strip() or not text.isprintable():
        raise ConfigError(f"{key} must be the path of a folder, found {text!r}")


def named_run_file(config: Mapping[str, Any], name: str, stage: str) -> Path | None:
    """A stage's file of a run that has a name of its own, beside this config's; None if there is none."""
    if not name or name != Path(name).name or name.startswith("."):
        return None
    folder = Path(config["artifacts"]) / f"{name}{config['effort']['suffix']}"
    path = folder / stage_named(stage).output
    return path if is_there(path) else None


@functools.cache
def _composed(overrides: tuple[str, ...]) -> dict[str, Any]:
    return compose(overrides)
