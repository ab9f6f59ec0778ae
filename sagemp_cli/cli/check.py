"""``sagemp check``."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sagemp_cli.cli.command import examples, printable
from sagemp_cli.cli.options import Json
from sagemp_cli.errors import ANSWER_CODES, UsageError

if TYPE_CHECKING:
    from sagemp_cli.checker.check import Finding, Report
    from sagemp_cli.pipeline.against import Difference

EXAMPLES = examples(
    "sagemp check artifacts/unicycle_node/certificate.h5",
    "sagemp check artifacts/unicycle_node/library.h5 --processes 2",
    "sagemp check certificate.h5 --against experiment=unicycle_node --against effort=demo",
    "sagemp check my_robot_Robot.h5 --against my_robot.py:Robot --network controller.onnx",
    "sagemp check certificate.h5 --json | jq .answer",
)


def check(
    file: Annotated[Path, typer.Argument(help="A certificate or a library, as somebody gave it to you.")],
    as_json: Json = False,
    processes: Annotated[int, typer.Option(min=1, help="Worker processes that share the cells.")] = 1,
    against: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=VALUE",
            help="Compare what is proved with the config of these overrides, e.g. experiment=unicycle_node; of an ODE "
            "with a robot of your own, FILE.py:NAME.",
            show_default=False,
        ),
    ] = None,
    network: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Of that robot: the ONNX file of its controller.", show_default=False),
    ] = None,
) -> None:
    """Prove a certificate or a library again, in ball arithmetic, from the file alone.

    Nothing in the file is believed, and no code but the checker's own is used: see docs/certificates.md for what is
    proved and what is trusted. The claim is printed in full; what the file only says of itself is marked. Exit code: 0
    if all references are proved, 10 if a counterexample in the file is, 5 if less is or if it does not cover what
    [bold]--against[/bold] asks for, 2 if the file is damaged or changed.
    """
    from sagemp_cli.checker.check import check as prove
    from sagemp_cli.checker.claim import claim_lines
    from sagemp_cli.cli.console import console_progress

    report = prove(file, processes=processes, progress=console_progress())
    found = None if not against else _compared(report, against, network)
    if as_json:
        typer.echo(json.dumps(as_data(report, found), indent=2))
    else:
        claim = claim_lines(report.document, _TITLES[report.answer])
        beside = [] if found is None else _against_lines(found)
        typer.echo(printable("\n".join([*claim, *beside, *as_lines(report)])))
    code = ANSWER_CODES[report.answer]
    raise typer.Exit(code if found is None or code or all(d.covers for d in found) else ANSWER_CODES["UNKNOWN"])


def _compared(report: Report, against: list[str], network: Path | None) -> list[Difference]:
    """What differs between the file and a config, or a robot as an ODE."""
    if ".py:" in against[0]:
        from sagemp_cli.plugins.loading import load_object
        from sagemp_cli.stages.against_plant import plant_differences
        from sagemp_cli.stages.prove_ode import plant_of

        if len(against) > 1:
            raise UsageError("--against takes a config or one robot, FILE.py:NAME")
        return plant_differences(report, plant_of(load_object(against[0])[0], network))
    if network is not None:
        raise UsageError("--network means nothing here: it is of a robot, --against FILE.py:NAME")
    from sagemp_cli.config.composition import compose
    from sagemp_cli.pipeline.against import differences

    return differences(report, compose(against))


def _against_lines(found: list[Difference]) -> list[str]:
    """What differs, for people."""
    if not found:
        return ["against the config: no difference"]
    covered = all(d.covers for d in found)
    lines = [f"against the config: {'covers' if covered else 'does NOT cover'} what it asks"]
    return lines + [
        f"  {d.what}: proved {d.proved}, asked {d.asked}: {'covers' if d.covers else 'does NOT cover'}" for d in found
    ]


def as_lines(report: Report) -> list[str]:
    """What was proved and what was not, for people."""
    proved = sum(f.proved for f in report.findings)
    lines = [
        f"{report.answer}: {proved} of {len(report.findings)} references proved, {report.cells} cells, K ="
        f" {report.horizon} (the file claims {report.claimed})",
        *(f"  the file: {problem}" for problem in report.problems),
    ]
    lines += [_line(f, "reference", falsified=report.answer == "FALSIFIED") for f in report.findings]
    if report.true_model is not None:
        lines.append("  the robot is a network learned from an analytical model; of that model itself:")
        lines += [_line(f, "  reference") for f in report.true_model]
    lines += [f"  counterexample to reference {r}: NOT PROVED: {why}" for r, why in report.counterexamples if why]
    took = f"checked in {report.seconds:.2f} s"
    lines.append(f"{took}; the proof took {report.proof_seconds:.2f} s" if report.proof_seconds > 0 else took)
    return lines


def _line(f: Finding, what: str, *, falsified: bool = False) -> str:
    if falsified and f.claimed == "UNSAFE":  # a file is FALSIFIED only if each of these has a proved counterexample
        return f"  {what} {f.reference}: UNSAFE: its counterexample is proved"
    if not f.proved:
        verb = "NOT PROVED" if f.claimed == "SAFE" else f.claimed
        return f"  {what} {f.reference}: {verb}: {f.reason}"
    near = min(f.clearance, key=f.clearance.__getitem__, default=None)
    clear = "" if near is None else f", keeps {f.clearance[near]:.3g} m from {near}"
    goal = min(f.goal_margin, key=f.goal_margin.__getitem__, default=None)
    inside = f", ends {f.goal_margin[goal]:.3g} inside the goal ({goal})" if goal else ""
    return f"  {what} {f.reference}: proved{clear}{inside}"


_TITLES = {
    "VERIFIED": "this is proved:",
    "FALSIFIED": "this is claimed of the loop, and refuted:",
    "UNKNOWN": "this is claimed, NOT proved:",
}


def as_data(report: Report, found: list[Difference] | None = None) -> dict[str, Any]:
    """The same as plain data."""
    from sagemp_cli.checker.claim import claim_rows, said_rows

    return {
        "file": str(report.path),
        "kind": report.kind,
        "claimed": report.claimed,
        "answer": report.answer,
        "exit_code": ANSWER_CODES[report.answer],
        "horizon": report.horizon,
        "cells": report.cells,
        "problems": list(report.problems),
        "references": [_finding(f) for f in report.findings],
        "true_model": None if report.true_model is None else [_finding(f) for f in report.true_model],
        "claim": [list(row) for row in claim_rows(report.document)],
        "said": [list(row) for row in said_rows(report.document)],
        "against": None if found is None else [dataclasses.asdict(d) for d in found],
        "counterexamples": [{"reference": r, "proved": not why, "reason": why} for r, why in report.counterexamples],
        "seconds": report.seconds,
        "proof_seconds": report.proof_seconds,
    }


def _finding(f: Finding) -> dict[str, Any]:
    return {
        "reference": f.reference,
        "claimed": f.claimed,
        "proved": f.proved,
        "reason": f.reason,
        "clearance": dict(f.clearance),
        "goal_margin": dict(f.goal_margin),
    }
