"""``sagemp run``."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sagemp_cli.cli.command import examples, printable
from sagemp_cli.cli.completion import complete_stage
from sagemp_cli.cli.options import DryRun, Overrides, Partitions, Seed, TimeLimit, overrides_of
from sagemp_cli.cli.stage_command import announce, context_of, draw_if_missing
from sagemp_cli.cli.time_limit import time_limit as limited
from sagemp_cli.errors import EXIT_FALSIFIED, ArtifactError, UsageError, did_you_mean

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
        str | None,
        typer.Option(
            metavar="STAGE",
            help="Last stage to run, e.g. verify.",
            show_default=False,
            autocompletion=complete_stage,
        ),
    ] = None,
    partitions: Partitions = None,
    seed: Seed = None,
    dry_run: DryRun = False,
    time_limit: TimeLimit = None,
) -> None:
    """Make every file of an experiment that is missing or stale, in order, also those it takes from another one.

    Files that are up to date are left alone; stale ones are remade and replaced ([bold]--dry-run[/bold] shows
    which), of trained ones the earlier file is kept beside it as NAME-before.h5. Interrupted, the same command goes
    on. After a verdict FALSIFIED no library is built. The exit code is that of the verdict: 0 certified, 10 falsified,
    5 unknown.
    """
    from sagemp_cli.cli import verdict
    from sagemp_cli.pipeline.stage import all_stages, stages_of

    names = [stage.name for stage in all_stages()]
    if until is not None and until not in names:
        raise UsageError(f"--until {until}: no such stage{did_you_mean(until, names)}; known: {', '.join(names)}")
    context = context_of(overrides_of(overrides, seed=seed, partitions=partitions), overwrite=True)
    wanted = stages_of(context.config)
    if until is not None:
        own = [stage.name for stage in wanted]
        if until not in own:
            raise UsageError(f"--until {until}: {context.config['name']} has no such stage; it has {', '.join(own)}")
        wanted = wanted[: own.index(until) + 1]
    own = [stage.name for stage in wanted]
    proved = own.index("verify") + 1 if "verify" in own else len(own)
    with limited(time_limit):
        _make(context, wanted[:proved], dry_run=dry_run)
        if dry_run or "verify" not in own:
            _make(context, wanted[proved:], dry_run=dry_run)
            return
        certificate = verdict.read_certificate(context.output_path("verify"))
        again = verdict.rechecked(certificate)  # it may have been there already, and been changed since
        draw_if_missing(context, wanted[proved - 1])
        code = verdict.exit_code(certificate)
        try:
            if code != EXIT_FALSIFIED:
                _make(context, wanted[proved:], dry_run=dry_run)
            elif wanted[proved:]:
                typer.echo(f"{', '.join(own[proved:])}: not made, the claim is refuted")
        finally:
            typer.echo(printable("\n".join([f"verify: {again}", *verdict.as_lines(certificate)])))
    raise typer.Exit(code)


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
            if not dry_run and stage.name != "verify":  # a verdict is looked at before a figure is drawn of it
                draw_if_missing(context, stage)
            continue
        experiment = state.header.experiment if state.header else context.config["name"]
        if experiment != context.config["name"]:
            raise ArtifactError(
                f"{state.path}: is of '{experiment}' and was put there by hand, 'sagemp run' does not replace it; "
                f"move it away{_sourced(stage, experiment)}"
            )
        why = "missing" if state.freshness is Freshness.MISSING else f"stale: {state.why}"
        typer.echo(f"{prefix}{stage.name}: {'would be made' if dry_run else 'making it'} ({why})")
        if not dry_run and state.freshness is Freshness.STALE and stage.name.startswith("train-"):
            typer.echo(f"{prefix}{stage.name}: the earlier file is kept as {_set_aside(state.path)}")
        if not dry_run:
            announce(stage.run(dataclasses.replace(context, started=time.monotonic())))


def _set_aside(path: Path) -> Path:
    """Move what took long to make out of the way; of several earlier ones the last is kept."""
    kept = path.with_name(f"{path.stem}-before{path.suffix}")
    os.replace(path, kept)
    return kept


def _sourced(stage: Stage, experiment: str) -> str:
    return f", or say sources.{stage.name}={experiment}" if stage.name.startswith("train-") else ""
