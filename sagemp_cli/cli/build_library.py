"""``sagemp build-library``."""

from __future__ import annotations

from sagemp_cli.cli.command import examples
from sagemp_cli.cli.options import DryRun, Overrides, Overwrite, Partitions, SampleSeed, TimeLimit, overrides_of
from sagemp_cli.cli.stage_command import run_stage

EXAMPLES = examples(
    "sagemp build-library",
    "sagemp build-library library.size=20 library.budget=200",
    "sagemp build-library --partitions 2x2",
)


def build_library(
    overrides: Overrides = None,
    partitions: Partitions = None,
    seed: SampleSeed = None,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
    time_limit: TimeLimit = None,
) -> None:
    """Collect certified references of the planner (Algorithm 2).

    Reads planner.h5 and tracker.h5 and writes library.h5; rejected references are counted by reason.
    """
    given = overrides_of(overrides, seed=seed, seed_of="library", partitions=partitions)
    run_stage("build-library", given, overwrite=overwrite, dry_run=dry_run, seconds=time_limit)
