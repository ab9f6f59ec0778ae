"""``sagemp verify``."""

from __future__ import annotations

import json

import typer

from sagemp_cli.cli.command import examples
from sagemp_cli.cli.options import DryRun, Json, Overrides, Overwrite, Partitions, Seed, TimeLimit, overrides_of
from sagemp_cli.cli.stage_command import context_of, explain, refuse_existing_output, require_inputs
from sagemp_cli.cli.time_limit import time_limit as limited

EXAMPLES = examples(
    "sagemp verify",
    "sagemp verify experiment=unicycle_node --partitions 4",
    "sagemp verify --partitions 2x2 propagator=auto_lirpa --overwrite",
    "sagemp verify --partitions auto verify.budget=100",
    "sagemp verify verify.file=plans.npz executor=processes",
    "sagemp verify --json | jq .verdict",
)


def verify(
    overrides: Overrides = None,
    partitions: Partitions = None,
    seed: Seed = None,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
    as_json: Json = False,
    time_limit: TimeLimit = None,
) -> None:
    """Prove that the closed loop stays safe and reaches the goal, or find a counterexample.

    Reads planner.h5 and tracker.h5, writes certificate.h5 and prints the verdict. If there is a certificate of
    exactly this config already, its verdict is printed. With verify.file=FILE all references of an HDF5 or NPZ file
    are verified instead of the planner's. An interrupted run goes on from its finished cells. Exit code: 0 certified,
    10 falsified, 5 unknown.
    """
    from sagemp_cli.cli import verdict
    from sagemp_cli.stages.freshness import Freshness, survey

    given = overrides_of(overrides, seed=seed, partitions=partitions)
    context = context_of(given, overwrite=overwrite)
    states = survey(context)
    state = states["verify"]
    known = state.freshness is Freshness.FRESH and not overwrite
    if not known:
        refuse_existing_output(state, overwrite)
        require_inputs(context, states, "verify", given)
    if dry_run:
        if known:
            typer.echo(f"sagemp verify would print the verdict of {state.path}, which is up to date")
        else:
            explain(context, states, "verify")
        return
    with limited(time_limit):
        path = state.path if known else state.stage.run(context)
    certificate = verdict.read_certificate(path)
    if as_json:
        typer.echo(json.dumps(verdict.as_json(certificate) | {"from_file": known}, indent=2))
    else:
        if known:
            typer.echo(f"up to date, from the file of {state.header.created_utc if state.header else ''}:")
        typer.echo("\n".join(verdict.as_lines(certificate)))
    raise typer.Exit(verdict.exit_code(certificate))
