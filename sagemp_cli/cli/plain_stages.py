"""The commands of stages that write a file and print nothing of it: one function."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sagemp_cli.cli.command import examples
from sagemp_cli.cli.options import DryRun, Overrides, Overwrite, Partitions, SampleSeed, Seed, TimeLimit, overrides_of
from sagemp_cli.cli.stage_command import run_stage


@dataclass(frozen=True)
class PlainStage:
    """The command of a stage: its name, help (paragraphs) and examples.

    ``seed_of`` is the section whose seed ``--seed`` is, empty for the root of all; ``partitions`` says whether the
    stage takes ``--partitions``.
    """

    name: str
    help: str
    examples: tuple[str, ...]
    seed_of: str = ""
    partitions: bool = False

    @property
    def epilog(self) -> str:
        """The examples as the end of its help."""
        return examples(*self.examples)


PREPARING = (
    PlainStage(
        "gen-data",
        "Expert demonstrations by trajectory optimisation.\n\n"
        "Solves for trajectories under the exact discrete dynamics, on both sides of the obstacles, and writes "
        "demonstrations.h5. Interrupted, it goes on where it stopped.",
        (
            "sagemp gen-data",
            "sagemp gen-data experiment=unicycle_node expert.count=100 --seed 1",
            "sagemp gen-data effort=demo --dry-run",
        ),
    ),
    PlainStage(
        "train-dynamics",
        "Learn a robot model from transitions of its analytical model.\n\n"
        "Writes dynamics.h5, with the errors on transitions that were held out. Only for experiments with a learned "
        "robot.",
        (
            "sagemp train-dynamics experiment=unicycle_node_learned",
            "sagemp train-dynamics dynamics=unicycle_learned dynamics_training.steps=2000",
            "sagemp train-dynamics dynamics=unicycle_learned dynamics.activation=tanh --overwrite",
        ),
    ),
    PlainStage(
        "train-planner",
        "Train the generative planner on the demonstrations.\n\n"
        "Reads demonstrations.h5 and writes planner.h5, weights and model card.",
        (
            "sagemp train-planner",
            "sagemp train-planner planner.hidden=32 --overwrite",
            "sagemp train-planner effort=demo --time-limit 600",
        ),
    ),
    PlainStage(
        "train-tracker",
        "Train the tracking controller by back-propagation through rollouts.\n\n"
        "Reads planner.h5 and writes tracker.h5: one small controller for all references.",
        (
            "sagemp train-tracker",
            "sagemp train-tracker 'tracker.hidden=[8,8]' tracker.lookahead=10",
            "sagemp train-tracker --seed 1 --overwrite",
        ),
    ),
)
USING = (
    PlainStage(
        "build-library",
        "Collect certified references of the planner (Algorithm 2).\n\n"
        "Reads planner.h5 and tracker.h5 and writes library.h5; rejected references are counted by reason.",
        (
            "sagemp build-library",
            "sagemp build-library library.size=20 library.budget=200",
            "sagemp build-library --partitions 2x2",
        ),
        seed_of="library",
        partitions=True,
    ),
    PlainStage(
        "execute",
        "Track the closest certified reference (Algorithm 3).\n\n"
        "Reads library.h5, plans afresh from measured starts, rolls out under disturbances and writes rollouts.h5.",
        (
            "sagemp execute",
            "sagemp execute execute.queries=10 execute.rollouts=100 --seed 3",
            "sagemp execute --dry-run",
        ),
        seed_of="execute",
    ),
)


def from_outside(name: str, function: Callable[..., Any]) -> PlainStage:
    """The command of a stage that a plugin brings; its function's docstring is the help."""
    shown = (f"sagemp {name}", f"sagemp {name} --overwrite")
    return PlainStage(name, inspect.getdoc(function) or f"Make {name}.h5.", shown)


def function_of(stage: PlainStage) -> Callable[..., None]:
    """What the command of a stage does; its parameters are its options."""

    def make(
        overrides: Overrides = None,
        partitions: Partitions = None,
        seed: Seed = None,
        overwrite: Overwrite = False,
        dry_run: DryRun = False,
        time_limit: TimeLimit = None,
    ) -> None:
        given = overrides_of(overrides, seed=seed, seed_of=stage.seed_of, partitions=partitions)
        run_stage(stage.name, given, overwrite=overwrite, dry_run=dry_run, seconds=time_limit)

    signature = inspect.signature(make, eval_str=True)
    options = dict(signature.parameters)
    if not stage.partitions:
        del options["partitions"]
    if stage.seed_of:
        options["seed"] = options["seed"].replace(annotation=SampleSeed)
    make.__doc__ = stage.help
    # Typer reads both, and the docstring is the help.
    make.__signature__ = signature.replace(parameters=list(options.values()))  # pyright: ignore[reportFunctionMemberAccess]
    make.__annotations__ = {name: option.annotation for name, option in options.items()}
    return make
