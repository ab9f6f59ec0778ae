"""``sagemp execute``."""

from __future__ import annotations

from sagemp_cli.cli.command import examples
from sagemp_cli.cli.options import DryRun, Overrides, Overwrite, SampleSeed, TimeLimit, overrides_of
from sagemp_cli.cli.stage_command import run_stage

EXAMPLES = examples(
    "sagemp execute",
    "sagemp execute execute.queries=10 execute.rollouts=100 --seed 3",
    "sagemp execute --dry-run",
)


def execute(
    overrides: Overrides = None,
    seed: SampleSeed = None,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
    time_limit: TimeLimit = None,
) -> None:
    """Track the closest certified reference (Algorithm 3).

    Reads library.h5, plans afresh from measured starts, rolls out under disturbances and writes rollouts.h5.
    """
    given = overrides_of(overrides, seed=seed, seed_of="execute")
    run_stage("execute", given, overwrite=overwrite, dry_run=dry_run, seconds=time_limit)
