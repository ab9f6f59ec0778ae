"""``sagemp run``."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from sagemp_cli.cli.command import examples, printable
from sagemp_cli.cli.options import DryRun, Overrides, Partitions, Seed, TimeLimit, overrides_of
from sagemp_cli.cli.stage_command import announce, context_of
from sagemp_cli.cli.time_limit import time_limit as limited
from sagemp_cli.errors import ArtifactError, UsageError, did_you_mean

if TYPE_CHECKING:
    from sagemp_cli.pipeline.context import StageContext
    from sagemp_cli.pipeline.stage import Stage

EXAMPLES = examples(
    "sagemp run",
    "sagemp run experiment=unicycle_node effort=demo",
    "sagemp run --until verify --partitions 4",
    "sagemp run planner.hidden=32 --dry-run",
)


def run(
    overrides: Overrides = None,
    until: Annotated[
        str | None, typer.Option(metavar="STAGE", help="Last stage to run, e.g. verify.", show_default=False)
    ] = None,
    partitions: Partitions = None,
    seed: Seed = None,
    dry_run: DryRun = False,
    time_limit: TimeLimit = None,
) -> None:
    """Make every file of an experiment that is missing or stale, in order, also those it takes from another one.

    Files that are up to date are left alone; stale ones are remade and replaced ([bold]--dry-run[/bold] shows
    which). Interrupted, the same command goes on. The exit code is that of the verdict: 0 certified, 10
    falsified, 5 unknown.
    """
    from sagemp_cli.cli import verdict
    from sagemp_cli.pipeline.stage import STAGES, stages_of

    names = [stage.name for stage in STAGES]
    if until is not None and until not in names:
        raise UsageError(f"--until {until}: no such stage{did_you_mean(until, names)}; known: {', '.join(names)}")
    context = context_of(overrides_of(overrides, seed=seed, partitions=partitions), overwrite=True)
    wanted = stages_of(context.config)
    if until is not None:
        own = [stage.name for stage in wanted]
        if until not in own:
            raise UsageError(f"--until {until}: {context.config['name']} has no such stage; it has {', '.join(own)}")
        wanted = wanted[: own.index(until) + 1]
    with limited(time_limit):
        _make(context, wanted, dry_run=dry_run)
    if dry_run or "verify" not in [stage.name for stage in wanted]:
        return
    certificate = verdict.read_certificate(context.output_path("verify"))
    typer.echo(printable("\n".join(verdict.as_lines(certificate))))
    raise typer.Exit(verdict.exit_code(certificate))


def _make(context: StageContext, stages: Sequence[Stage], *, dry_run: bool, prefix: str = "") -> None:
    """Make what is missing or stale of these stages' files, first in the experiments that some are taken from."""
    from sagemp_cli.pipeline.freshness import Freshness, survey
    from sagemp_cli.pipeline.stage import stages_of

    for stage in stages:
        owner = context.owner(stage.name)
        if owner is not context:
            theirs = stages_of(owner.config, (stage.name,))
            _make(owner, theirs, dry_run=dry_run, prefix=f"{owner.config['name']}: ")
            continue
        state = survey(context)[stage.name]
        if state.freshness is Freshness.DAMAGED:
            raise ArtifactError(f"{state.path}: {state.why}; move it away, 'sagemp run' does not replace it")
        if state.freshness is Freshness.FRESH:
            typer.echo(f"{prefix}{stage.name}: up to date ({state.path})")
            continue
        why = "missing" if state.freshness is Freshness.MISSING else f"stale: {state.why}"
        typer.echo(f"{prefix}{stage.name}: {'would be made' if dry_run else 'making it'} ({why})")
        if not dry_run:
            announce(stage.run(dataclasses.replace(context, started=time.monotonic())))
