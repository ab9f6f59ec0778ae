"""``sagemp status``."""

from __future__ import annotations

import json

import typer

from sagemp_cli.cli.command import examples, printable
from sagemp_cli.cli.options import Json, Overrides, Partitions, Seed, overrides_of
from sagemp_cli.cli.rows import rows_of, terminal_width
from sagemp_cli.cli.stage_command import maker

EXAMPLES = examples(
    "sagemp status",
    "sagemp status experiment=unicycle_node effort=demo",
    "sagemp status --json | jq '.files[].state'",
)


def status(
    overrides: Overrides = None, partitions: Partitions = None, seed: Seed = None, as_json: Json = False
) -> None:
    """Show an experiment's graph of files: fresh, stale, missing or damaged, and why.

    A file is stale if a config key that it depends on, or one of its inputs, has changed since it was made. Values of
    options are compared, not checked: that is what 'sagemp config validate' and every stage do.
    """
    from sagemp_cli.config.composition import compose
    from sagemp_cli.pipeline.context import StageContext
    from sagemp_cli.pipeline.freshness import Freshness, survey
    from sagemp_cli.pipeline.outline import require_sound_outline

    given = overrides_of(overrides, seed=seed, partitions=partitions)
    config = compose(given)
    require_sound_outline(config)
    context = StageContext.of(config, typed=tuple(given))
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
    made = {n: f"made {s.header.created_utc[:16].replace('T', ' ')} UTC" if s.header else "" for n, s in states.items()}
    cells = [("stage", "reads", "file", "state")]
    for name, state in states.items():
        reads = [states[i].stage.role for i in state.stage.inputs_in(context.config) if i in states]
        cells.append((name, ", ".join(reads) or "-", state.path.name, str(state.freshness)))
    notes = ["note", *(why[name] or made[name] for name in states)]
    width = terminal_width()
    lines = rows_of(cells, notes, width=width)
    if width is not None and max(map(len, lines)) > width:  # a narrow terminal: what a stage reads goes first
        lines = rows_of([(stage, file, state) for stage, _, file, state in cells], notes, width=width)
    typer.echo(f"{context.config['name']} in {context.folder}")
    typer.echo(printable("\n".join(lines)))
