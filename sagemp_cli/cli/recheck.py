"""``sagemp recheck``."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sagemp_cli.cli.command import examples, printable
from sagemp_cli.cli.options import Json, Overwrite
from sagemp_cli.errors import ANSWER_CODES

if TYPE_CHECKING:
    from sagemp_cli.stages.recheck import Rechecked

EXAMPLES = examples(
    "sagemp recheck artifacts/planar_node/library.h5 moved.yaml",
    "sagemp recheck artifacts/planar_node/library.h5 moved.yaml --output moved/library.h5",
    "sagemp recheck certificate.h5 slalom --json | jq .answer",
)
SHOWN = 20


def recheck(
    file: Annotated[Path, typer.Argument(help="A certificate or a library.")],
    scene: Annotated[str, typer.Argument(help="Name or YAML file of another scene, e.g. with an obstacle moved.")],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Write the file of that scene.", show_default=False),
    ] = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Compare stored tubes with moved, added or removed obstacles, without propagating anything.

    A tube does not depend on the scene. The tubes are taken from the file: that the robot stays in them is proved by
    'sagemp check'. With [bold]--output[/bold] a certificate or a library of the other scene is written, which
    'sagemp check' proves; of a library the references that are still certified. Exit code: 0 if all are certified in
    the other scene, 5 if less is.
    """
    from sagemp_cli.stages.recheck import recheck as judge

    found = judge(file, scene, output=output, overwrite=overwrite)
    data = as_data(found)
    typer.echo(json.dumps(data, indent=2) if as_json else printable("\n".join(as_lines(found, scene))))
    raise typer.Exit(data["exit_code"])


def as_data(found: Rechecked) -> dict[str, Any]:
    """What was found as plain data."""
    certified = sum(v.outcome == "SAFE" for v in found.verdicts)
    answer = "VERIFIED" if certified == len(found.verdicts) else "UNKNOWN"
    return {
        "answer": answer,
        "exit_code": ANSWER_CODES[answer],
        "certified": certified,
        "references": [
            {
                "before": before,
                "verdict": str(v.outcome),
                "step": None if v.step < 0 else v.step,
                "fraction": None if v.step < 0 else v.fraction,
                "constraint": v.constraint,
            }
            for before, v in zip(found.before, found.verdicts, strict=True)
        ],
        "seconds": found.seconds,
        "written": None if found.written is None else str(found.written),
    }


def as_lines(found: Rechecked, scene: str) -> list[str]:
    """What was found, for people: the references that changed, and those that are not certified."""
    count, certified = len(found.verdicts), sum(v.outcome == "SAFE" for v in found.verdicts)
    before = sum(v == "SAFE" for v in found.before)
    lines = [f"{certified} of {count} references certified in '{scene}' ({before} in the file's own scene)"]
    rows = []
    for r, (was, verdict) in enumerate(zip(found.before, found.verdicts, strict=True)):
        if verdict.outcome != "SAFE":
            rows.append(f"  reference {r}: {verdict}")
        elif was != "SAFE":
            rows.append(f"  reference {r}: SAFE, {was} in the file's own scene")
    lines += rows[:SHOWN]
    if len(rows) > SHOWN:
        reasons = Counter(f"{v.outcome} ({v.constraint})" for v in found.verdicts if v.outcome != "SAFE")
        lines.append(f"  and {len(rows) - SHOWN} more; in all " + ", ".join(f"{n} x {r}" for r, n in reasons.items()))
    lines.append(f"compared in {1e3 * found.seconds:.3g} ms; the tubes are the file's: 'sagemp check' proves them")
    if found.written is not None:
        lines.append(f"written: {found.written}")
    return lines
