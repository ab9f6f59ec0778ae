"""``sagemp status``."""

from __future__ import annotations

import json

import typer

from sagemp_cli.cli.command import examples
from sagemp_cli.cli.options import Json, Overrides, Partitions, Seed, overrides_of
from sagemp_cli.cli.stage_command import context_of, maker

EXAMPLES = examples(
    "sagemp status",
    "sagemp status experiment=unicycle_node effort=demo",
    "sagemp status --json | jq '.files[].state'",
)
_STYLES = {"fresh": "green", "stale": "yellow", "missing": "dim", "damaged": "red"}


def status(
    overrides: Overrides = None, partitions: Partitions = None, seed: Seed = None, as_json: Json = False
) -> None:
    """Show an experiment's graph of files: fresh, stale, missing or damaged, and why.

    A file is stale if a config key that it depends on, or one of its inputs, has changed since it was made.
    """
    from sagemp_cli.pipeline.freshness import Freshness, survey

    given = overrides_of(overrides, seed=seed, partitions=partitions)
    context = context_of(given)
    states = survey(context)
    why = {
        name: maker(context, name) if state.freshness is Freshness.MISSING else state.why
        for name, state in states.items()
    }
    if as_json:
        files = [
            {
                "stage": name,
                "file": str(state.path),
                "inputs": list(state.stage.inputs_in(context.config)),
                "state": str(state.freshness),
                "why": why[name],
                "created_utc": state.header.created_utc if state.header else None,
                "seconds": state.header.seconds if state.header else None,
                "sha256": state.sha256 or None,
            }
            for name, state in states.items()
        ]
        typer.echo(
            json.dumps({"experiment": context.config["name"], "folder": str(context.folder), "files": files}, indent=2)
        )
        return
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    if not console.is_terminal:
        console = Console(width=200)  # nobody resizes a pipe: one line per file
    table = Table(box=None, padding=(0, 2, 0, 0))
    for column in ("stage", "reads", "file", "state"):
        table.add_column(column, no_wrap=True)
    table.add_column("note", overflow="fold")
    for name, state in states.items():
        made = f"made {state.header.created_utc[:16].replace('T', ' ')} UTC" if state.header else ""
        table.add_row(
            name,
            ", ".join(states[i].stage.role for i in state.stage.inputs_in(context.config) if i in states) or "-",
            state.path.name,
            Text(str(state.freshness), style=_STYLES[state.freshness]),
            Text(why[name] or made),
        )
    console.print(f"{context.config['name']} in {context.folder}", markup=False, highlight=False)
    console.print(table)
