"""``sagemp train-tracker``."""

from __future__ import annotations

from sagemp_cli.cli.command import examples
from sagemp_cli.cli.options import DryRun, Overrides, Overwrite, Seed, TimeLimit, overrides_of
from sagemp_cli.cli.stage_command import run_stage

EXAMPLES = examples(
    "sagemp train-tracker",
    "sagemp train-tracker 'tracker.hidden=[8,8]' tracker.lookahead=10",
    "sagemp train-tracker --seed 1 --overwrite",
)


def train_tracker(
    overrides: Overrides = None,
    seed: Seed = None,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
    time_limit: TimeLimit = None,
) -> None:
    """Train the tracking controller by back-propagation through rollouts.

    Reads planner.h5 and writes tracker.h5: one small controller for all references.
    """
    given = overrides_of(overrides, seed=seed)
    run_stage("train-tracker", given, overwrite=overwrite, dry_run=dry_run, seconds=time_limit)
