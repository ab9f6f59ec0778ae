"""What the six stage commands share: compose the config, check, run one stage, say what it wrote."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from sagemp_cli.cli.time_limit import time_limit
from sagemp_cli.errors import ArtifactError

if TYPE_CHECKING:
    from sagemp_cli.stages.freshness import FileState
    from sagemp_cli.stages.stage import StageContext


def context_of(overrides: list[str], *, overwrite: bool = False) -> StageContext:
    """The context of a call: config composed and checked, progress on the console."""
    import torch

    from sagemp_cli.cli.console import console_progress
    from sagemp_cli.config import compose
    from sagemp_cli.stages.requirements import require_sound_config
    from sagemp_cli.stages.stage import StageContext

    torch.set_num_threads(1)  # several processes with several threads each slow each other down many times over
    config = compose(overrides)
    require_sound_config(config)
    return StageContext.of(config, overwrite=overwrite, progress=console_progress())


def run_stage(name: str, overrides: list[str], *, overwrite: bool, dry_run: bool, seconds: float | None = None) -> None:
    """Run one stage and print the path of what it wrote."""
    from sagemp_cli.stages.freshness import survey

    context = context_of(overrides, overwrite=overwrite)
    states = survey(context, last=name)
    refuse_existing_output(states[name], overwrite)
    require_inputs(context, states, name, overrides)
    if dry_run:
        explain(context, states, name)
        return
    with time_limit(seconds):
        announce(states[name].stage.run(context))


def refuse_existing_output(state: FileState, overwrite: bool) -> None:
    """Raise if the output is there already: nothing that exists is replaced unasked."""
    from sagemp_cli.stages.freshness import Freshness

    if overwrite or state.freshness is Freshness.MISSING:
        return
    what = {
        Freshness.FRESH: "exists already and is up to date",
        Freshness.STALE: f"exists already and is stale ({state.why})",
        Freshness.DAMAGED: f"exists already ({state.why})",
    }[state.freshness]
    raise ArtifactError(f"{state.path}: {what}; pass --overwrite to remake it ('sagemp run' skips what is up to date)")


def require_inputs(context: StageContext, states: dict[str, FileState], name: str, overrides: list[str]) -> None:
    """Raise if an input is not there, and say which command makes it."""
    from sagemp_cli.stages.freshness import Freshness

    read = states[name].stage.inputs_in(context.config)
    missing = [s for s in read if states[s].freshness is Freshness.MISSING]
    if missing:
        said = "".join(f" {shlex.quote(o)}" for o in overrides)
        owner = context.owner(missing[0])
        where = said if owner is context else f" experiment={owner.config['name']}"
        raise ArtifactError(
            f"{states[missing[0]].path}: missing; make it with 'sagemp {missing[0]}{where}'"
            f" (or 'sagemp run{said}', which makes everything that is missing)"
        )


def explain(context: StageContext, states: dict[str, FileState], name: str) -> None:
    """Say what a stage would read and write."""
    state = states[name]
    typer.echo(f"sagemp {name} would")
    for source in state.stage.inputs_in(context.config):
        typer.echo(f"  read     {states[source].path} ({states[source].freshness})")
    typer.echo(f"  {'replace' if state.path.exists() else 'write'}    {state.path}")


def announce(path: Path) -> None:
    """Print where a stage's output and its figure are."""
    typer.echo(f"wrote  {path}")
    figure = path.with_suffix(".png")
    if figure.exists():
        typer.echo(f"figure {figure}")
