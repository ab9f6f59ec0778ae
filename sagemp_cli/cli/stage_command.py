"""What the stage commands share: compose the config, check, run one stage, say what it wrote."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from sagemp_cli.cli.time_limit import time_limit
from sagemp_cli.errors import ArtifactError

if TYPE_CHECKING:
    from sagemp_cli.pipeline.context import StageContext
    from sagemp_cli.pipeline.freshness import FileState
    from sagemp_cli.pipeline.stage import Stage


def context_of(overrides: list[str], *, overwrite: bool = False) -> StageContext:
    """The context of a call: config composed and checked, progress on the console."""
    import torch

    from sagemp_cli.cli.console import console_progress
    from sagemp_cli.config.composition import compose
    from sagemp_cli.pipeline.context import StageContext
    from sagemp_cli.pipeline.requirements import require_sound_config

    torch.set_num_threads(1)  # several processes with several threads each slow each other down many times over
    config = compose(overrides)
    require_sound_config(config)
    return StageContext.of(config, overwrite=overwrite, progress=console_progress(), typed=tuple(overrides))


def run_stage(name: str, overrides: list[str], *, overwrite: bool, dry_run: bool, seconds: float | None) -> None:
    """Run one stage and print the path of what it wrote."""
    made = output_of(name, overrides, overwrite=overwrite, dry_run=dry_run, seconds=seconds)
    if made is not None:
        announce(made[0])


def output_of(
    name: str,
    overrides: list[str],
    *,
    overwrite: bool,
    dry_run: bool,
    seconds: float | None,
    shown: str = "",
    first: Callable[[Path], object] = lambda path: None,
) -> tuple[Path, bool] | None:
    """The path of a stage's output, and whether it was there already; None if the stage is not to run.

    Args:
        name: of the stage.
        overrides: of the config.
        overwrite: whether an existing output may be replaced.
        dry_run: only say what would be done.
        seconds: time limit.
        shown: what the command prints of an output that is up to date; without it such an output is in the way.
        first: looks at such an output before a figure is drawn of it, and raises if it is not what it says.
    """
    from sagemp_cli.pipeline.freshness import Freshness, survey
    from sagemp_cli.pipeline.stage import stage_named

    context = context_of(overrides, overwrite=overwrite)
    stage_named(name).require_own(context)
    states = survey(context, last=name)
    state = states[name]
    known = bool(shown) and state.freshness is Freshness.FRESH and not overwrite
    if dry_run and state.freshness is Freshness.FRESH and not overwrite and not known:
        typer.echo(f"sagemp {name} would do nothing: {state.path} is up to date; --overwrite remakes it")
        return None
    if not known:
        _refuse_existing(state, overwrite)
        _require_inputs(context, states, name)
    if dry_run:
        if known:
            typer.echo(f"sagemp {name} would print {shown} of {state.path}, which is up to date")
        else:
            explain(context, states, name)
        return None
    with time_limit(seconds):
        if not known:
            return state.stage.run(context), known
        first(state.path)
        draw_if_missing(context, state.stage)
        return state.path, known


def _refuse_existing(state: FileState, overwrite: bool) -> None:
    """Raise if the output is there already: nothing that exists is replaced unasked."""
    from sagemp_cli.pipeline.freshness import Freshness

    if overwrite or state.freshness is Freshness.MISSING:
        return
    what = {
        Freshness.FRESH: "exists already and is up to date",
        Freshness.STALE: f"exists already and is stale ({state.why})",
        Freshness.DAMAGED: f"exists already ({state.why})",
    }[state.freshness]
    raise ArtifactError(f"{state.path}: {what}; pass --overwrite to remake it ('sagemp run' skips what is up to date)")


def _require_inputs(context: StageContext, states: dict[str, FileState], name: str) -> None:
    """Raise if an input is not there, and say which command makes it."""
    from sagemp_cli.pipeline.freshness import Freshness

    read = states[name].stage.inputs_in(context.config)
    missing = [s for s in read if states[s].freshness is Freshness.MISSING]
    if missing:
        raise ArtifactError(
            f"{states[missing[0]].path}: missing; {maker(context, missing[0])}"
            f" (or '{context.command('run')}', which makes everything that is missing)"
        )


def maker(context: StageContext, name: str) -> str:
    """The command that makes a stage's file, as it is typed: with this call's overrides, or in its own experiment."""
    return f"make it with '{context.owner(name).command(name)}'"


def explain(context: StageContext, states: dict[str, FileState], name: str) -> None:
    """Say what a stage would read and write."""
    state = states[name]
    typer.echo(f"sagemp {name} would")
    for source in state.stage.inputs_in(context.config):
        typer.echo(f"  read     {states[source].path} ({states[source].freshness})")
    typer.echo(f"  {'replace' if state.path.exists() else 'write':<7}  {state.path}")


def draw_if_missing(context: StageContext, stage: Stage) -> None:
    """Draw the figure of a file that is up to date, if it is not there: an interrupt may have come before it."""
    if context.owner(stage.name) is context and not context.output_path(stage.name).with_suffix(".png").exists():
        drawn = stage.draw(context)
        if drawn is not None:
            context.progress.say(f"figure {drawn}")


def announce(path: Path) -> None:
    """Print where a stage's output and its figure are."""
    typer.echo(f"wrote  {path}")
    figure = path.with_suffix(".png")
    if figure.exists():
        typer.echo(f"figure {figure}")
