"""What a stage is: which files it reads, which file it writes, which config keys its output depends on.

A stage opens artifacts, builds objects from config, calls the core and writes one file; the mathematics is
elsewhere. The table :data:`STAGES`, and what plugins add to it, is all that ``run``, ``status`` and the commands know
about them.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sagemp_cli.config.binding import NAME, Binding, attribute_of_target
from sagemp_cli.errors import ConfigError, did_you_mean
from sagemp_cli.pipeline.own_stage import OwnVerb
from sagemp_cli.plugins.stages import OwnStage, own_stages
from sagemp_cli.storage import (
    Certificate,
    Demonstrations,
    DynamicsModel,
    Library,
    PlannerModel,
    Rollouts,
    SafetyRates,
    TrackerModel,
    refuse_existing,
)

if TYPE_CHECKING:
    from sagemp_cli.pipeline.context import StageContext


@dataclass(frozen=True)
class Stage:
    """One step of the pipeline.

    Attributes:
        name: the command.
        output: file name of what it writes, in the experiment's folder.
        record: record class of that file.
        inputs: names of the stages whose outputs it reads, where those apply.
        sections: dotted config keys that its output depends on, beyond those of its inputs.
        irrelevant: keys in these sections that only say where the work is done, and change nothing in the output.
        learns: whether, under a config, it makes anything of these inputs at all.
        applies: whether an experiment has this stage at all, from its config.
        variant: what distinguishes its output from the experiment's own, from its config; empty if nothing does.
        seed: dotted key of its seed; that of a stage that only samples is its own, and another one is no contradiction
            to what reads its file.
        own: of a stage from outside what it does; None for those in :mod:`sagemp_cli.stages`.
    """

    name: str
    output: str
    record: type
    inputs: tuple[str, ...]
    sections: tuple[str, ...]
    irrelevant: tuple[str, ...] = ()
    learns: Callable[[Mapping[str, Any]], bool] = lambda config: True
    applies: Callable[[Mapping[str, Any]], bool] = lambda config: True
    variant: Callable[[Mapping[str, Any]], str] = lambda config: ""
    seed: str = "seed"
    own: OwnVerb | None = None

    def output_in(self, config: Mapping[str, Any]) -> str:
        """File name of what it writes under a config."""
        variant = self.variant(config)
        return f"{self.role}-{variant}.h5" if variant else self.output

    def inputs_in(self, config: Mapping[str, Any]) -> tuple[str, ...]:
        """Names of the stages whose outputs it reads in an experiment."""
        return tuple(name for name in self.inputs if self.learns(config) and stage_named(name).applies(config))

    def seed_in(self, config: Mapping[str, Any]) -> int:
        """Its seed under a config."""
        return int(_value(config, self.seed, without=()))

    def settings(self, config: Mapping[str, Any], *, without: Sequence[str] = ()) -> dict[str, Any]:
        """What its output depends on in a config: its sections by their keys, None where one is absent.

        Args:
            config: resolved config.
            without: further keys in these sections to leave out.
        """
        return {key: _value(config, key, without=(*self.irrelevant, *without)) for key in self.sections}

    def difference(
        self, found: Mapping[str, Any], wanted: Mapping[str, Any], *, without: Sequence[str] = ()
    ) -> tuple[str, Any, Any] | None:
        """The first dotted key that its output depends on and that differs in two configs, with both values."""
        before, now = (self.settings(_with_later_keys(config), without=without) for config in (found, wanted))
        return next((_difference(key, before[key], now[key]) for key in now if before[key] != now[key]), None)

    @property
    def role(self) -> str:
        """Name of the output among the parents of another artifact."""
        return self.output.removesuffix(".h5")

    def run(self, context: StageContext) -> Path:
        """Run the stage (``sagemp_cli.stages.<name>.run``), draw its figure, and return the path of what it wrote.

        Raises:
            ConfigError: another experiment makes the file, or the stage has :meth:`complaints`.
        """
        self.require_own(context)
        refuse_existing(context.output_path(self.name), context.overwrite)
        wrong = self.complaints(context.config)
        if wrong:
            raise ConfigError("; ".join(wrong))
        with context.resources:
            path = self._module.run(context)
        self.draw(context)
        return path

    def draw(self, context: StageContext) -> Path | None:
        """Draw the figure of the stage's file, which is there (``sagemp_cli.stages.<name>.draw``); return its path.

        None if there is nothing to draw: a tracker that was trained elsewhere, a stage from outside.
        """
        return self._module.draw(context)

    def require_own(self, context: StageContext) -> None:
        """Raise if the file comes from elsewhere.

        Raises:
            ConfigError: it does, and says which command makes it there.
        """
        owner = context.owner(self.name)
        if owner is not context:
            raise ConfigError(
                f"sources.{self.name}: {context.config['name']} takes {self.output} from {owner.config['name']}; "
                f"make it with '{owner.command(self.name)}'"
            )

    def bindings(self, config: Mapping[str, Any]) -> tuple[Binding, ...]:
        """The sections that this stage reads and what takes them, beside those that pick a thing by name."""
        found = getattr(self._module, "SECTIONS", None)
        return self._module.sections(config) if found is None else found

    def complaints(self, config: Mapping[str, Any]) -> list[str]:
        """What is wrong with these sections, one line each."""
        if not self.applies(config):
            return []
        return [complaint for binding in self.bindings(config) for complaint in binding.complaints(config)]

    @property
    def _module(self) -> Any:
        return self.own or importlib.import_module(f"sagemp_cli.stages.{self.name.replace('-', '_')}")


def _has_demonstrations(config: Mapping[str, Any]) -> bool:
    """Whether the planner learns from an expert; one of a file or one that teaches itself does not."""
    return attribute_of_target(config["planner"], "planner", "learns_from", None) == "demonstrations"


def _learns_its_robot(config: Mapping[str, Any]) -> bool:
    """Whether the robot is a learned one."""
    return config["dynamics"].get(NAME) == "learned"


def _trains_its_tracker(config: Mapping[str, Any]) -> bool:
    """Whether the tracker is trained here; one that was trained elsewhere is taken as it is."""
    return attribute_of_target(config["tracker"], "tracker", "trains", True)


def _references_file(config: Mapping[str, Any]) -> str:
    """The name of the file of references, whose certificate is not the experiment's own."""
    file = config["verify"]["file"]
    return "" if file is None else Path(file).stem


_ROBOT = ("name", "dynamics", "scene", "horizon")

STAGES = (
    Stage(
        "gen-data",
        "demonstrations.h5",
        Demonstrations,
        (),
        (*_ROBOT, "expert", "start", "seed"),
        irrelevant=("expert.processes",),
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
        (*_ROBOT, "tracker", "tracker_training", "start", "disturbance", "seed"),
        learns=_trains_its_tracker,
    ),
    Stage(
        "verify",
        "certificate.h5",
        Certificate,
        ("train-dynamics", "train-planner", "train-tracker"),
        (*_ROBOT, "propagator", "proof", "verify", "library.start_spread", "start", "disturbance"),
        variant=_references_file,
        seed="verify.seed",
    ),
    Stage(
        "build-library",
        "library.h5",
        Library,
        ("train-dynamics", "train-planner", "train-tracker"),
        (*_ROBOT, "propagator", "proof", "library", "start", "disturbance"),
        seed="library.seed",
    ),
    Stage(
        "execute",
        "rollouts.h5",
        Rollouts,
        ("train-dynamics", "train-planner", "train-tracker", "build-library"),
        (*_ROBOT, "execute", "start", "disturbance"),
        seed="execute.seed",
    ),
    Stage(
        "safety-rates",
        "safety.h5",
        SafetyRates,
        ("train-dynamics", "train-planner", "train-tracker"),
        (*_ROBOT, "propagator", "proof", "library.start_spread", "safety", "start", "disturbance"),
        seed="safety.seed",
    ),
)


def all_stages() -> tuple[Stage, ...]:
    """Those of the package and then those from outside, each after what it reads.

    Raises:
        ConfigError: one from outside reads what no stage before it writes.
    """
    found = list(STAGES)
    for own in own_stages():
        names = [stage.name for stage in found]
        for wanted in own.inputs:
            if wanted not in names:
                near = did_you_mean(wanted, names) or f"; known before it: {', '.join(names)}"
                raise ConfigError(f"stage '{own.name}': no stage '{wanted}' whose file it could read{near}")
        found.append(_from_outside(own))
    return tuple(found)


def _from_outside(own: OwnStage) -> Stage:
    sections = (*_ROBOT, *own.sections, own.section, "seed")
    return Stage(own.name, f"{own.name}.h5", own.record, own.inputs, sections, own=OwnVerb(own))


def stage_named(name: str) -> Stage:
    """The stage of a command."""
    known = next((s for s in STAGES if s.name == name), None)
    return known or next(s for s in all_stages() if s.name == name)


def stages_of(config: Mapping[str, Any], last: Sequence[str] | None = None) -> list[Stage]:
    """The stages that an experiment's ``last`` ones need, in order, themselves included.

    By default these are verify, build-library and execute, and those from outside; others are made only when they are
    asked for by name. Of a stage whose file another experiment makes, the inputs are that experiment's affair.
    """
    every, needed = all_stages(), set[str]()
    waiting = list(last or ("verify", "build-library", "execute", *(s.name for s in every if s.own)))
    while waiting:
        name = waiting.pop()
        if name not in needed:
            needed.add(name)
            if config["sources"].get(name) is None:
                waiting += stage_named(name).inputs_in(config)
    return [stage for stage in every if stage.name in needed]


_LATER: Mapping[str, Any] = {
    "dynamics.time": "discrete",
    "dynamics.model.time": "discrete",
    **{f"dynamics.{model}{key}": 0.0 for model in ("", "model.") for key in ("delay", "jitter")},
    "proof.substeps": "auto",
    "proof.order": "auto",
}
"""Keys that came after files had been written without them, and what it means not to say them."""


def _with_later_keys(config: Mapping[str, Any]) -> Mapping[str, Any]:
    """A config with what it does not say."""
    found = dict(config)
    for dotted, value in _LATER.items():
        *sections, key = dotted.split(".")
        node, inner = config, found
        for part in sections:
            node = node.get(part)
            if not isinstance(node, Mapping):
                break
            inner[part] = dict(inner[part])
            inner = inner[part]
        else:
            inner.setdefault(key, value)
    return found


def _value(config: Mapping[str, Any], dotted: str, *, without: Sequence[str]) -> Any:
    node: Any = config
    for part in dotted.split("."):
        node = node.get(part) if isinstance(node, Mapping) else None
    if isinstance(node, Mapping):
        return {key: value for key, value in node.items() if f"{dotted}.{key}" not in without}
    return node


def _difference(key: str, found: Any, wanted: Any) -> tuple[str, Any, Any]:
    if isinstance(found, Mapping) and isinstance(wanted, Mapping):
        for k in [*wanted, *(k for k in found if k not in wanted)]:
            old, new = found.get(k, "nothing"), wanted.get(k, "nothing")
            if old != new:
                return _difference(f"{key}.{k}", old, new)
    return key, found, wanted
