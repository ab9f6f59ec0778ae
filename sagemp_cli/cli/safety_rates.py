"""``sagemp safety-rates``."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sagemp_cli.cli.command import examples
from sagemp_cli.cli.options import DryRun, Json, Overrides, Overwrite, Partitions, SampleSeed, TimeLimit, overrides_of
from sagemp_cli.cli.stage_command import announce, output_of
from sagemp_cli.errors import UsageError

if TYPE_CHECKING:
    from sagemp_cli.report.safety_table import SafetyRow

EXAMPLES = examples(
    "sagemp safety-rates experiment=planar_diffusion",
    "sagemp safety-rates experiment=planar_cfm safety.references=20 safety.rollouts=100",
    "sagemp safety-rates --table",
    "sagemp safety-rates --table --json | jq '.[] | select(.way == \"certified\")'",
)


def safety_rates(
    overrides: Overrides = None,
    table: Annotated[
        bool, typer.Option("--table", help="Run nothing: one table of all experiments in artifacts/ that were run.")
    ] = False,
    partitions: Partitions = None,
    seed: SampleSeed = None,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
    as_json: Json = False,
    time_limit: TimeLimit = None,
) -> None:
    """Compare how many of the planner's references are safe open loop, under the tracker, and certified.

    Reads planner.h5 and tracker.h5, samples references, executes each from all over X_I with its controls played back
    and with the tracker, proves what it can from all of X_I, writes safety.h5 and prints the rates beside the paper's.
    If there is a safety.h5 of exactly this config already, its rates are printed. An interrupted run goes on from its
    finished cells.
    """
    from sagemp_cli.report.safety_table import all_safety_rows, safety_rows
    from sagemp_cli.storage import SafetyRates, read_artifact

    given = overrides_of(overrides, seed=seed, seed_of="safety", partitions=partitions)
    if table:
        if overwrite or dry_run or time_limit is not None:
            raise UsageError(
                "--table only reads what there is; give it without --overwrite, --dry-run and --time-limit"
            )
        _show(all_safety_rows(_root(given)), as_json=as_json)
        return
    made = output_of("safety-rates", given, overwrite=overwrite, dry_run=dry_run, seconds=time_limit, shown="the rates")
    if made is None:
        return
    _show(safety_rows(read_artifact(made[0], SafetyRates)), as_json=as_json)
    if not as_json:
        announce(made[0])


def _root(given: Sequence[str]) -> Path:
    """The folder of all experiments: ``artifacts``, unless an override names another."""
    from sagemp_cli.config.composition import compose

    others = [override for override in given if not override.startswith("artifacts=")]
    if others:
        raise UsageError(f"--table shows every experiment there is; {others[0]} has no effect on it, artifacts=DIR has")
    return Path(compose(given)["artifacts"])


def _show(rows: Sequence[SafetyRow], *, as_json: bool) -> None:
    from sagemp_cli.report.safety_table import table_lines

    if as_json:
        typer.echo(json.dumps([dataclasses.asdict(row) for row in rows], indent=2))
    else:
        typer.echo("\n".join(table_lines(rows)))
