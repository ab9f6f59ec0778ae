"""What Tab completes: options of config groups, config keys, stages. Nothing heavy is imported."""

from __future__ import annotations

from typing import Any

import typer

from sagemp_cli.errors import SagempError

PIPELINE = "The pipeline"
"""Panel of the help that the stages are in."""


def complete_override(ctx: typer.Context, incomplete: str) -> list[str]:
    """Overrides that begin with what is typed: ``experiment=unicycle_node``, ``planner.hidden=``.

    Bash splits words at ``=``: it asks for what follows, and the words before are among the arguments.
    """
    from sagemp_cli.config.composition import groups, known_keys, options_of

    words = " ".join(ctx.params.get("overrides") or []).replace(" = ", "=").removesuffix(" =").split()
    try:
        if words and "=" not in words[-1]:
            return [option for option in options_of(words[-1]) if option.startswith(incomplete)]
        group, given, typed = incomplete.partition("=")
        if given:
            return [f"{group}={option}" for option in options_of(group) if option.startswith(typed)]
        names = dict.fromkeys([*groups(), *known_keys([word for word in words if "=" in word])])
        return [f"{name}=" for name in names if name.startswith(incomplete)]
    except SagempError:
        return []  # what was typed before is wrong, which the command will say


def complete_stage(ctx: typer.Context, incomplete: str) -> list[str]:
    """Stages that begin with what is typed."""
    root: Any = ctx.find_root().command
    stages = [name for name, command in root.commands.items() if command.rich_help_panel == PIPELINE]
    stages += [name for name in root.list_commands(ctx) if name not in root.commands]
    return [name for name in stages if name.startswith(incomplete)]
