"""The ``sagemp`` command: its subcommands in the order of the pipeline."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import typer

from sagemp_cli import __version__
from sagemp_cli.cli import (
    check,
    config,
    doctor,
    export,
    init,
    inspect,
    prove,
    recheck,
    run,
    safety_rates,
    status,
    verify,
)
from sagemp_cli.cli.command import add_command, errors_as_lines, examples
from sagemp_cli.cli.completion import PIPELINE
from sagemp_cli.cli.plain_stages import PREPARING, USING, PlainStage, function_of
from sagemp_cli.cli.stages_from_outside import Commands

app = typer.Typer(
    name="sagemp",
    cls=Commands,
    rich_markup_mode="rich",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=examples(
        "sagemp run experiment=unicycle_node effort=demo",
        "sagemp verify --partitions 4",
        "sagemp status",
        "sagemp --plugin my_robot.py run experiment=my_robot",
        "sagemp COMMAND --help",
    ),
)

_PIPELINE, _AROUND = PIPELINE, "Around it"


def _plain(stage: PlainStage) -> tuple[str, Callable[..., None], str, str]:
    return stage.name, function_of(stage), stage.epilog, _PIPELINE


for _name, _function, _examples, _panel in (
    *map(_plain, PREPARING),
    ("verify", verify.verify, verify.EXAMPLES, _PIPELINE),
    *map(_plain, USING),
    ("safety-rates", safety_rates.safety_rates, safety_rates.EXAMPLES, _PIPELINE),
    ("init", init.init, init.EXAMPLES, _AROUND),
    ("run", run.run, run.EXAMPLES, _AROUND),
    ("prove", prove.prove, prove.EXAMPLES, _AROUND),
    ("check", check.check, check.EXAMPLES, _AROUND),
    ("recheck", recheck.recheck, recheck.EXAMPLES, _AROUND),
    ("status", status.status, status.EXAMPLES, _AROUND),
    ("inspect", inspect.inspect, inspect.EXAMPLES, _AROUND),
    ("doctor", doctor.doctor, doctor.EXAMPLES, _AROUND),
):
    add_command(app, _name, _function, help=_function.__doc__ or "", epilog=_examples, panel=_panel)
app.add_typer(config.app, name="config", rich_help_panel=_AROUND)
app.add_typer(export.app, name="export", rich_help_panel=_AROUND)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"sagemp {__version__}")
        raise typer.Exit


def _load_plugins(plugins: list[str] | None) -> list[str] | None:
    """Before the command is looked up, which a plugin may bring."""
    if plugins:
        from sagemp_cli.plugins.loading import load_all

        with errors_as_lines():
            load_all(plugins)
    return plugins


@app.callback()
def sagemp(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version and exit.")
    ] = False,
    plugin: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FILE",
            callback=_load_plugins,
            is_eager=True,
            help="A Python file or module that brings a robot, planner, ... of your own; may be given several times.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Plans from generative models, tracked by a small neural controller, proved safe by reachability.

    Every command reads and writes HDF5 files in artifacts/ and takes config overrides as KEY=VALUE.
    """


def main() -> None:
    """Entry point of the ``sagemp`` command."""
    app(prog_name="sagemp")
