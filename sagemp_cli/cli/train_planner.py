"""``sagemp train-planner``."""

from __future__ import annotations

from sagemp_cli.cli.command import examples
from sagemp_cli.cli.options import DryRun, Overrides, Overwrite, Seed, TimeLimit, overrides_of
from sagemp_cli.cli.stage_command import run_stage

EXAMPLES = examples(
    "sagemp train-planner",
    "sagemp train-planner planner.hidden=32 --overwrite",
    "sagemp train-planner effort=demo --time-limit 600",
)


def train_planner(
    overrides: Overrides = None,
    seed: Seed = None,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
    time_limit: TimeLimit = None,
) -> None:
    """Train the generative planner on the demonstrations.

    Reads demonstrations.h5 and writes planner.h5, weights and model card.
    """
    given = overrides_of(overrides, seed=seed)
    run_stage("train-planner", given, overwrite=overwrite, dry_run=dry_run, seconds=time_limit)
