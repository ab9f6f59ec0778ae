"""What a stage is: which files it reads, which file it writes, which config keys its output depends on.

A stage opens artifacts, builds objects from config, calls the core and writes one file; the mathematics is
elsewhere. The table :data:`STAGES` is all that ``run``, ``status`` and the commands know about them.
"""

from __future__ import annotations

import functools
import hashlib
import importlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from sagemp_cli.binding import target_class
from sagemp_cli.config import compose
from sagemp_cli.dynamics.learned import Learned
from sagemp_cli.errors import ArtifactError, ConfigError
from sagemp_cli.progress import Progress, Silent
from sagemp_cli.storage import (
    Artifact,
    Certificate,
    Demonstrations,
    DynamicsModel,
    Header,
    Library,
    Parent,
    PlannerModel,
    Rollouts,
    SafetyRates,
    TrackerModel,
    read_artifact,
    refuse_existing,
    sha256_of,
    write_artifact,
)


@dataclass(frozen=True)
class Stage:
    """One step of the pipeline.

    Attributes:
        name: the command.
        output: file name of what it writes, in the experiment's folder.
        record: record class of that file.
        inputs: names of the stages whose outputs it reads, where those apply.
        sections: dotted config keys that its output depends on, beyond those of its inputs.
        applies: whether an experiment has this stage at all, from its config.
    """

    name: str
    output: str
    record: type
    inputs: tuple[str, ...]
    sections: tuple[str, ...]
    applies: Callable[[Mapping[str, Any]], bool] = lambda config: True

    def inputs_in(self, config: Mapping[str, Any]) -> tuple[str, ...]:
        """Names of the stages whose outputs it reads in an experiment."""
        return tuple(name for name in self.inputs if stage_named(name).applies(config))

    @property
    def role(self) -> str:
        """Name of the output among the parents of another artifact."""
        return self.output.removesuffix(".h5")

    def run(self, context: StageContext) -> Path:
        """Run the stage (``sagemp_cli.stages.<name>.run``) and return the path of what it wrote."""
        owner = context.owner(self.name)
        if owner is not context:
            raise ConfigError(
                f"sources.{self.name}: {context.config['name']} takes {self.output} from {owner.config['name']}; "
                f"make it with 'sagemp {self.name} experiment={owner.config['name']}'"
            )
        refuse_existing(context.output_path(self.name), context.overwrite)
        return importlib.import_module(f"sagemp_cli.stages.{self.name.replace('-', '_')}").run(context)


def _has_demonstrations(config: Mapping[str, Any]) -> bool:
    """Whether the planner learns from an expert; one of a file or one that teaches itself does not."""
    return getattr(target_class(config["planner"], "planner"), "learns_from", None) == "demonstrations"


def _learns_its_robot(config: Mapping[str, Any]) -> bool:
    """Whether the robot is a learned one."""
    return target_class(config["dynamics"], "dynamics") is Learned


_ROBOT = ("name", "dynamics", "scene", "horizon")
# Memory decides which cells are propagated together, which changes the last bits of their tubes.
_PARTITION = ("verify.partitions", "verify.budget", "verify.memory")

STAGES = (
    Stage(
        "gen-data",
        "demonstrations.h5",
        Demonstrations,
        (),
        (*_ROBOT, "expert", "start", "seed"),
        applies=_has_demonstrations,
    ),
    Stage(
        "train-dynamics",
        "dynamics.h5",
        DynamicsModel,
        (),
        ("name", "dynamics", "dynamics_training", "seed"),
        applies=_learns_its_robot,
    ),
    Stage("train-planner", "planner.h5", PlannerModel, ("gen-data",), (*_ROBOT, "planner", "planner_training", "seed")),
    Stage(
        "train-tracker",
        "tracker.h5",
        TrackerModel,
        ("train-dynamics", "train-planner"),
        (*_ROBOT, "tracker", "training", "start", "disturbance", "seed"),
    ),
    Stage(
        "verify",
        "certificate.h5",
        Certificate,
        ("train-dynamics", "train-planner", "train-tracker"),
        (*_ROBOT, "propagator", "verify", "start", "disturbance", "seed"),
    ),
    Stage(
        "build-library",
        "library.h5",
        Library,
        ("train-dynamics", "train-planner", "train-tracker"),
        (*_ROBOT, "propagator", *_PARTITION, "library", "start", "disturbance", "seed"),
    ),
    Stage(
        "execute",
        "rollouts.h5",
        Rollouts,
        ("train-dynamics", "train-planner", "train-tracker", "build-library"),
        (*_ROBOT, "execute", "start", "disturbance", "seed"),
    ),
    Stage(
        "safety-rates",
        "safety.h5",
        SafetyRates,
        ("train-dynamics", "train-planner", "train-tracker"),
        (*_ROBOT, "propagator", *_PARTITION, "library.start_spread", "safety", "start", "disturbance", "seed"),
    ),
)


def stage_named(name: str) -> Stage:
    """The stage of a command."""
    return next(s for s in STAGES if s.name == name)


def stages_of(config: Mapping[str, Any], last: tuple[str, ...] = ("verify", "build-library", "execute")) -> list[Stage]:
    """The stages that an experiment's ``last`` ones need, in order, themselves included.

    Those that are not among the default ``last`` ones are made only when they are asked for by name.

    Of a stage whose file another experiment makes, the inputs are that experiment's affair.
    """
    needed: set[str] = set()
    waiting = list(last)
    while waiting:
        name = waiting.pop()
        if name not in needed:
            needed.add(name)
            if config["sources"].get(name) is None:
                waiting += stage_named(name).inputs_in(config)
    return [stage for stage in STAGES if stage.name in needed]


def section(config: Mapping[str, Any], dotted: str) -> Any:
    """The value of a dotted key, None where it is absent; without what only says where the work is done."""
    node: Any = config
    for part in dotted.split("."):
        node = node.get(part) if isinstance(node, Mapping) else None
    if dotted == "expert" and isinstance(node, Mapping):
        return {key: value for key, value in node.items() if key != "processes"}
    return node


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

        The other experiment is run as it is in its own file: of this call's overrides it only gets seed, effort,
        artifacts and device.

        Raises:
            ConfigError: sources that lead back to where they started.
        """
        here, passed = self, [self.config["name"]]
        while (name := here.config["sources"].get(stage)) is not None:
            if name in passed:
                raise ConfigError(f"sources.{stage}: {' -> '.join([*passed, name])} goes in a circle")
            passed.append(name)
            shared = {key: here.config[key] for key in ("seed", "artifacts", "device")}
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
        if not path.exists():
            raise ArtifactError(
                f"{path}: missing; make it with 'sagemp {stage} experiment={self.config['name']}'"
                f" (or 'sagemp run', which makes everything that is missing)"
            )
        artifact = read_artifact(path, made_by.record)
        for key in made_by.sections:
            found, wanted = section(artifact.header.config, key), section(self.config, key)
            if found != wanted:
                where, a, b = first_difference(key, found, wanted)
                raise ArtifactError(
                    f"{path}: was made with {where}={a}, this config says {b}; "
                    f"remake it with 'sagemp {stage} --overwrite' or drop the override"
                )
        for parent in artifact.header.parents:
            source = self.folder / parent.path
            if not source.exists():
                continue  # an input that is gone cannot contradict what was made from it
            if sha256_of(source) != parent.sha256:
                raise ArtifactError(
                    f"{path}: was made from an earlier {source}, which has changed since; "
                    f"remake it with 'sagemp {stage} --overwrite'"
                )
        return artifact

    def write(
        self,
        stage: str,
        record: Any,
        parents: tuple[Artifact[Any], ...] = (),
        files: tuple[Parent, ...] = (),
    ) -> Path:
        """Write a stage's output with its provenance: the artifacts and other files that it was made from."""
        header = Header(
            stage=stage,
            experiment=str(self.config["name"]),
            config=self.config,
            seed=self.seed,
            parents=(*(p.as_parent(p.path.stem, self.folder) for p in parents), *files),
            seconds=time.monotonic() - self.started,
            device=str(self.config["device"]),
        )
        return write_artifact(self.output_path(stage), record, header, overwrite=self.overwrite)


@functools.cache
def _composed(overrides: tuple[str, ...]) -> dict[str, Any]:
    return compose(overrides)


def first_difference(key: str, found: Any, wanted: Any) -> tuple[str, Any, Any]:
    """The first dotted key at which two config values differ, with both values."""
    if isinstance(found, Mapping) and isinstance(wanted, Mapping):
        for k in [*wanted, *(k for k in found if k not in wanted)]:
            if found.get(k) != wanted.get(k):
                return first_difference(f"{key}.{k}", found.get(k), wanted.get(k))
    return key, found, wanted
