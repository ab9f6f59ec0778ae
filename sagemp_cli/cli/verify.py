"""``sagemp verify``."""

from __future__ import annotations

import json

import typer

from sagemp_cli.cli.command import examples, printable
from sagemp_cli.cli.options import DryRun, Json, Overrides, Overwrite, Partitions, SampleSeed, TimeLimit, overrides_of
from sagemp_cli.cli.stage_command import output_of

EXAMPLES = examples(
    "sagemp verify",
    "sagemp verify experiment=unicycle_node --partitions 4",
    "sagemp verify --partitions 2x2 propagator=auto_lirpa --overwrite",
    "sagemp verify --partitions auto proof.budget=100",
    "sagemp verify verify.file=plans.npz executor=processes",
    "sagemp verify --json | jq .verdict",
)


def verify(
    overrides: Overrides = None,
    partitions: Partitions = None,
    seed: SampleSeed = None,
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

    given = overrides_of(overrides, seed=seed, seed_of="verify", partitions=partitions)
    rechecks: list[str] = []
    made = output_of(
        "verify",
        given,
        overwrite=overwrite,
        dry_run=dry_run,
        seconds=time_limit,
        shown="the verdict",
        first=lambda path: rechecks.append(verdict.rechecked(verdict.read_certificate(path))),
    )
    if made is None:
        return
    path, known = made
    certificate = verdict.read_certificate(path)
    again = rechecks[0] if known else None
    if as_json:
        typer.echo(json.dumps(verdict.as_json(certificate) | {"from_file": known, "rechecked": again}, indent=2))
    else:
        if known:
            typer.echo(f"up to date, from the file of {certificate.header.created_utc} ({again}):")
        typer.echo(printable("\n".join(verdict.as_lines(certificate))))
    raise typer.Exit(verdict.exit_code(certificate))
