"""``sagemp export tracker``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sagemp_cli.cli.command import Command, examples, printable
from sagemp_cli.cli.options import Overrides, Overwrite

app = typer.Typer(no_args_is_help=True, help="Write what was made here for other programs.", rich_markup_mode="rich")

EXAMPLES = examples(
    "sagemp export tracker --onnx net.onnx",
    "sagemp export tracker experiment=planar_node --onnx net.onnx --float32",
    "sagemp verify name=again tracker=onnx tracker.path=net.onnx",
)


@app.command(
    cls=Command,
    epilog=examples(
        "sagemp export monitor artifacts/unicycle_node/library.h5 --to robot/monitor.npz",
        "sagemp export monitor certificate.h5",
    ),
)
def monitor(
    file: Annotated[Path, typer.Argument(help="A certificate or a library.")],
    to: Annotated[Path, typer.Option("--to", metavar="FILE", help="The NPZ file to write.")] = Path("monitor.npz"),
    overwrite: Overwrite = False,
) -> None:
    """Write the tubes for the runtime monitor, and beside them the monitor itself: one file that needs only NumPy.

    On the robot [bold]Monitor.load("monitor.npz", reference=2)[/bold] compares each measured state with the tube; see
    its docstring. Only certified references are written; the tubes are the file's, 'sagemp check' proves them.
    """
    from sagemp_cli.stages.export_monitor import export_monitor

    count, module = export_monitor(file, to, overwrite=overwrite)
    typer.echo(printable(f"{file} -> {to} ({count} certified references), {module}"))


@app.command(cls=Command, epilog=EXAMPLES)
def tracker(
    onnx: Annotated[Path, typer.Option("--onnx", metavar="FILE", help="The ONNX file to write.")],
    overrides: Overrides = None,
    float32: Annotated[
        bool, typer.Option("--float32", help="Round its numbers to float32, which most runtimes prefer.")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Write an experiment's tracker as an ONNX network: from lookahead errors, (batch, N n), to controls, (batch, m).

    Scales, offset and saturation are in it. In float64 it holds the tracker's exact numbers; what
    [bold]--float32[/bold] changes is said. Needs the extra [bold]onnx[/bold].
    """
    from sagemp_cli.cli.stage_command import context_of
    from sagemp_cli.loop.onnx_format.writing import rounding_to_float32, write_onnx
    from sagemp_cli.pipeline.models import tracker_from

    artifact = context_of(list(overrides or [])).read("train-tracker")
    found = tracker_from(artifact)
    write_onnx(found, onnx, float32=float32, overwrite=overwrite)
    said = "float64, the tracker's exact numbers"
    if float32:
        number, control = rounding_to_float32(found)
        said = (
            f"float32: numbers are rounded by up to {number:.2g}, which changes controls by up to {control:.2g} on "
            "4096 random inputs between -1 and 1; measured, not proved"
        )
    typer.echo(printable(f"{artifact.path} -> {onnx} ({said})"))
