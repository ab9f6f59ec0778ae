"""The ``sagemp`` command: its subcommands in the order of the pipeline."""

from __future__ import annotations

from typing import Annotated

import typer

from sagemp_cli import __version__
from sagemp_cli.cli import (
    build_library,
    check,
    config,
    doctor,
    execute,
    export,
    gen_data,
    init,
    inspect,
    prove,
    run,
    safety_rates,
    status,
    train_dynamics,
    train_planner,
    train_tracker,
    verify,
)
from sagemp_cli.cli.command import Command, errors_as_lines, examples, flowing
from sagemp_cli.cli.completion import PIPELINE

app = typer.Typer(
    name="sagemp",
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
for _name, _function, _examples, _panel in (
    ("gen-data", gen_data.gen_data, gen_data.EXAMPLES, _PIPELINE),
    ("train-dynamics", train_dynamics.train_dynamics, train_dynamics.EXAMPLES, _PIPELINE),
    ("train-planner", train_planner.train_planner, train_planner.EXAMPLES, _PIPELINE),
    ("train-tracker", train_tracker.train_tracker, train_tracker.EXAMPLES, _PIPELINE),
    ("verify", verify.verify, verify.EXAMPLES, _PIPELINE),
    ("build-library", build_library.build_library, build_library.EXAMPLES, _PIPELINE),
    ("execute", execute.execute, execute.EXAMPLES, _PIPELINE),
    ("safety-rates", safety_rates.safety_rates, safety_rates.EXAMPLES, _PIPELINE),
    ("init", init.init, init.EXAMPLES, _AROUND),
    ("run", run.run, run.EXAMPLES, _AROUND),
    ("prove", prove.prove, prove.EXAMPLES, _AROUND),
    ("check", check.check, check.EXAMPLES, _AROUND),
    ("status", status.status, status.EXAMPLES, _AROUND),
    ("inspect", inspect.inspect, inspect.EXAMPLES, _AROUND),
    ("doctor", doctor.doctor, doctor.EXAMPLES, _AROUND),
):
    app.command(_name, cls=Command, help=flowing(_function), epilog=_examples, rich_help_panel=_panel)(_function)
app.add_typer(config.app, name="config", rich_help_panel=_AROUND)
app.add_typer(export.app, name="export", rich_help_panel=_AROUND)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"sagemp {__version__}")
        raise typer.Exit


@app.callback()
def sagemp(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version and exit.")
    ] = False,
    plugin: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FILE",
            help="A Python file or module that brings a robot, planner, ... of your own; may be given several times.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Plans from generative models, tracked by a small neural controller, proved safe by reachability.

    Every command reads and writes HDF5 files in artifacts/ and takes config overrides as KEY=VALUE.
    """
    if plugin:
        from sagemp_cli.plugins.loading import load_all

        with errors_as_lines():
            load_all(plugin)


def main() -> None:
    """Entry point of the ``sagemp`` command."""
    app(prog_name="sagemp")
