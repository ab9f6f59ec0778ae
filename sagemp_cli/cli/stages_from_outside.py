"""The group of all commands, where the stages that plugins bring are commands too; asked for only where they matter."""

from __future__ import annotations

from typing import Any

import typer
from typer.core import TyperGroup

from sagemp_cli.cli.command import add_command, errors_as_lines
from sagemp_cli.cli.completion import PIPELINE
from sagemp_cli.cli.plain_stages import from_outside, function_of
from sagemp_cli.errors import SagempError


class Commands(TyperGroup):
    """The package's commands, and for a name that is none of them a stage of that name."""

    def list_commands(self, ctx: Any) -> list[str]:
        """The names of all; of the package alone where a plugin does not load, which its commands will say."""
        from sagemp_cli.plugins.stages import own_stages

        try:
            return [*super().list_commands(ctx), *(stage.name for stage in own_stages())]
        except SagempError:
            return super().list_commands(ctx)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command of a name, None if there is none."""
        known = super().get_command(ctx, cmd_name)
        if known is not None or ctx.resilient_parsing:
            return known
        from sagemp_cli.plugins.stages import own_stages

        with errors_as_lines():
            found = {stage.name: stage for stage in own_stages()}
        return _command(found[cmd_name].name, found[cmd_name].function) if cmd_name in found else None


def _command(name: str, function: Any) -> Any:
    alone, stage = typer.Typer(add_completion=False, rich_markup_mode="rich"), from_outside(name, function)
    add_command(alone, name, function_of(stage), help=stage.help, epilog=stage.epilog, panel=PIPELINE)
    return typer.main.get_command(alone)
