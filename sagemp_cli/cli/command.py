"""How every command ends: the one place where errors become lines on stderr and exit codes."""

from __future__ import annotations

import inspect
import os
import traceback
from collections.abc import Callable
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from sagemp_cli.errors import EXIT_ERROR, EXIT_INTERRUPTED, SagempError

_WrongCall: Any = typer.BadParameter.__mro__[1]
"""The framework's own error of a call that it does not understand; it has no public name."""


class _Ending:
    """Errors reach the user as one line and an exit code of :mod:`sagemp_cli.errors`.

    ``SAGEMP_DEBUG=1`` shows the traceback as well.
    """

    def invoke(self, ctx: Any) -> Any:
        """Run the command and turn whatever it raises into a line and an exit code."""
        try:
            return super().invoke(ctx)  # type: ignore[misc]
        except (typer.Exit, _WrongCall):
            raise  # of an unknown command or option: the framework says it better, with exit code 2
        except SagempError as e:
            _complain(f"error: {e}")
            code = e.exit_code
        except KeyboardInterrupt:
            _complain(
                "interrupted: nothing half-written is left;"
                " run the same command again, finished pieces are not made twice"
            )
            code = EXIT_INTERRUPTED
        except BrokenPipeError:
            raise  # the reader of a pipe went away, which the framework ends quietly
        except Exception as e:
            what = " ".join(str(e).split())
            _complain(f"internal error: {type(e).__name__}: {what} (a bug of sagemp; SAGEMP_DEBUG=1 shows where)")
            code = EXIT_ERROR
        raise typer.Exit(code)


class Command(_Ending, TyperCommand):
    """A command."""


class Group(_Ending, TyperGroup):
    """All commands, with options of their own before them."""


def examples(*lines: str) -> str:
    """The part of a command's help that shows it in use."""
    return "\n\n".join(["[bold]Examples[/bold]", *(f"$ {line.replace('[', chr(92) + '[')}" for line in lines)])


def flowing(function: Callable[..., Any]) -> str:
    """A docstring as help text: paragraphs without line breaks, so that they fill the terminal's width."""
    paragraphs = (inspect.getdoc(function) or "").split("\n\n")
    return "\n\n".join(" ".join(p.split()) for p in paragraphs)


def printable(text: str) -> str:
    """Text of somebody else's file without what a terminal would obey, such as escape sequences."""
    return "".join(c if c.isprintable() or c == "\n" else "\N{REPLACEMENT CHARACTER}" for c in text)


def _complain(line: str) -> None:
    if os.environ.get("SAGEMP_DEBUG", "") not in ("", "0"):
        traceback.print_exc()
    typer.echo(printable(" ".join(line.split())), err=True)
