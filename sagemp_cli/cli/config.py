"""``sagemp config show | validate | list``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer

from sagemp_cli.cli.command import Command, examples
from sagemp_cli.cli.options import Overrides
from sagemp_cli.cli.rows import rows_of, terminal_width
from sagemp_cli.errors import ConfigError, UsageError

app = typer.Typer(no_args_is_help=True, help="Show, check and list the configuration.", rich_markup_mode="rich")


@app.command(cls=Command, epilog=examples("sagemp config show", "sagemp config show experiment=unicycle_node seed=3"))
def show(overrides: Overrides = None) -> None:
    """Print the resolved config, as it is stored in every artifact."""
    import yaml

    from sagemp_cli.config.composition import compose

    typer.echo(yaml.safe_dump(compose(overrides or []), sort_keys=False, default_flow_style=None), nl=False)


@app.command(cls=Command, epilog=examples("sagemp config validate", "sagemp config validate planner.hidden=32"))
def validate(overrides: Overrides = None) -> None:
    """Bind every option of every group to what it configures and report all errors at once.

    With overrides, the config that they give is checked instead.
    """
    from sagemp_cli.config.composition import compose, groups, options_of
    from sagemp_cli.pipeline.requirements import require_sound_config

    choices = [list(overrides)] if overrides else [[f"{g}={o}"] for g in groups() for o in options_of(g)]
    wrong = []
    for choice in choices:
        try:
            # Start, goal and disturbance belong to an experiment's robot, not to every robot there is.
            require_sound_config(compose(choice), problem=not choice[0].startswith(("dynamics=", "toy=")))
        except UsageError as e:
            wrong.append(f"{' '.join(choice)}: {e}")
    for line in wrong:
        typer.echo(line, err=True)
    if wrong:
        raise ConfigError(f"{len(wrong)} of {len(choices)} configs are wrong, see the lines above")
    typer.echo(f"{len(choices)} config{'s' if len(choices) > 1 else ''} checked, no errors")


@app.command("list", cls=Command, epilog=examples("sagemp config list", "sagemp config list experiment=unicycle_node"))
def list_options(overrides: Overrides = None) -> None:
    """List the config groups and their options; the ones in use are marked with a star."""
    from sagemp_cli.config.composition import chosen_options, groups, options_of
    from sagemp_cli.config.folders import config_file

    chosen, width = chosen_options(overrides or []), terminal_width()
    for group in groups():
        typer.echo(group)
        options = options_of(group)
        files = [config_file(group, option) for option in options]
        notes = ["a plugin" if path is None else _first_comment(path) for path in files]
        marked = [("  *" if chosen.get(group) == option else "   ", option) for option in options]
        for line in rows_of([(f"{mark} {option:<28}",) for mark, option in marked], notes, width=width):
            typer.echo(line)


def _first_comment(path: Path) -> str:
    """The first line of a file that is a comment for people."""
    lines: Any = path.read_text(encoding="utf-8").splitlines()
    comments = (line[1:].strip() for line in lines if line.startswith("#") and "@package" not in line)
    return next(comments, "")
