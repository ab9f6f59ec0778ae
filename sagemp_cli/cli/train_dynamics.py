"""``sagemp train-dynamics``."""

from __future__ import annotations

from sagemp_cli.cli.command import examples
from sagemp_cli.cli.options import DryRun, Overrides, Overwrite, Seed, TimeLimit, overrides_of
from sagemp_cli.cli.stage_command import run_stage

EXAMPLES = examples(
    "sagemp train-dynamics experiment=unicycle_node_learned",
    "sagemp train-dynamics dynamics=unicycle_learned dynamics_training.steps=2000",
    "sagemp train-dynamics dynamics=unicycle_learned dynamics.activation=tanh --overwrite",
)


def train_dynamics(
    overrides: Overrides = None,
    seed: Seed = None,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
    time_limit: TimeLimit = None,
) -> None:
    """Learn a robot model from transitions of its analytical model.

    Writes dynamics.h5, with the errors on transitions that were held out. Only for experiments with a learned robot.
    """
    given = overrides_of(overrides, seed=seed)
    run_stage("train-dynamics", given, overwrite=overwrite, dry_run=dry_run, seconds=time_limit)
