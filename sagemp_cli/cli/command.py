"""How every command ends: the one place where errors become lines on stderr and exit codes."""

from __future__ import annotations

import inspect
import os
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import typer
from typer.core import TyperCommand

from sagemp_cli.errors import EXIT_ERROR, EXIT_INTERRUPTED, SagempError


@contextmanager
def errors_as_lines() -> Iterator[None]:
    """Whatever is raised within becomes a line on stderr and an exit code of :mod:`sagemp_cli.errors`.

    ``SAGEMP_DEBUG=1`` shows the traceback as well.
    """
    try:
        yield
    except typer.Exit:
        raise
    except SagempError as e:
        _complain(f"error: {e}")
        raise typer.Exit(e.exit_code) from None
    except KeyboardInterrupt:
        _complain(
            "interrupted: nothing half-written is left; run the same command again, finished pieces are not made twice"
        )
        raise typer.Exit(EXIT_INTERRUPTED) from None
    except BrokenPipeError:
        raise  # the reader of a pipe went away, which the framework ends quietly
    except Exception as e:
        what = " ".join(str(e).split())
        _complain(f"internal error: {type(e).__name__}: {what} (a bug of sagemp; SAGEMP_DEBUG=1 shows where)")
        raise typer.Exit(EXIT_ERROR) from None


class Command(TyperCommand):
    """A command whose errors reach the user as lines, see :func:`errors_as_lines`."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        with errors_as_lines():
            return super().invoke(ctx)


def examples(*lines: str) -> str:
    """The part of a command's help that shows it in use."""
    return "\n\n".join(["[bold]Examples[/bold]", *(f"$ {line.replace('[', chr(92) + '[')}" for line in lines)])


def add_command(
    app: typer.Typer, name: str, function: Callable[..., Any], *, help: str, epilog: str, panel: str
) -> None:
    """Add a command to a group.

    Args:
        app: the group.
        name: of the command.
        function: what it does; its parameters are the options.
        help: a docstring.
        epilog: :func:`examples`.
        panel: of the group's help that it is listed in.
    """
    paragraphs = inspect.cleandoc(help).split("\n\n")  # without line breaks in them they fill the terminal's width
    flowing = "\n\n".join(" ".join(p.split()) for p in paragraphs)
    app.command(name, cls=Command, help=flowing, epilog=epilog, rich_help_panel=panel)(function)


def printable(text: str) -> str:
    """Text of somebody else's file without what a terminal would obey, such as escape sequences."""
    return "".join(c if c.isprintable() or c == "\n" else "\N{REPLACEMENT CHARACTER}" for c in text)


def _complain(line: str) -> None:
    if os.environ.get("SAGEMP_DEBUG", "") not in ("", "0"):
        traceback.print_exc()
    typer.echo(printable(" ".join(line.split())), err=True)
