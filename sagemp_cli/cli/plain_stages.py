"""The commands of stages that write a file and nothing else, with the seed that is the root of all: one function."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sagemp_cli.cli.command import examples
from sagemp_cli.cli.options import DryRun, Overrides, Overwrite, Seed, TimeLimit, overrides_of
from sagemp_cli.cli.stage_command import run_stage


@dataclass(frozen=True)
class PlainStage:
    """Name, help (paragraphs) and examples of the command of a stage."""

    name: str
    help: str
    examples: tuple[str, ...]

    @property
    def epilog(self) -> str:
        """The examples as the end of its help."""
        return examples(*self.examples)


PLAIN = (
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


def from_outside(name: str, function: Callable[..., Any]) -> PlainStage:
    """The command of a stage that a plugin brings; its function's docstring is the help."""
    shown = (f"sagemp {name}", f"sagemp {name} --overwrite")
    return PlainStage(name, inspect.getdoc(function) or f"Make {name}.h5.", shown)


def function_of(stage: str) -> Callable[..., None]:
    """What the command of a stage does, with its options."""

    def make(
        overrides: Overrides = None,
        seed: Seed = None,
        overwrite: Overwrite = False,
        dry_run: DryRun = False,
        time_limit: TimeLimit = None,
    ) -> None:
        given = overrides_of(overrides, seed=seed)
        run_stage(stage, given, overwrite=overwrite, dry_run=dry_run, seconds=time_limit)

    return make
