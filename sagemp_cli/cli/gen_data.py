"""``sagemp gen-data``."""

from __future__ import annotations

from sagemp_cli.cli.command import examples
from sagemp_cli.cli.options import DryRun, Overrides, Overwrite, Seed, TimeLimit, overrides_of
from sagemp_cli.cli.stage_command import run_stage

EXAMPLES = examples(
    "sagemp gen-data",
    "sagemp gen-data experiment=unicycle_node expert.count=100 --seed 1",
    "sagemp gen-data effort=demo --dry-run",
)


def gen_data(
    overrides: Overrides = None,
    seed: Seed = None,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
    time_limit: TimeLimit = None,
) -> None:
    """Expert demonstrations by trajectory optimisation.

    Solves for trajectories under the exact discrete dynamics, on both sides of the obstacles, and writes
    demonstrations.h5. Interrupted, it goes on where it stopped.
    """
    given = overrides_of(overrides, seed=seed)
    run_stage("gen-data", given, overwrite=overwrite, dry_run=dry_run, seconds=time_limit)
