"""``sagemp check``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sagemp_cli.cli.command import examples, printable
from sagemp_cli.cli.options import Json
from sagemp_cli.errors import ANSWER_CODES

if TYPE_CHECKING:
    from sagemp_cli.checker.check import Finding, Report

EXAMPLES = examples(
    "sagemp check artifacts/unicycle_node/certificate.h5",
    "sagemp check artifacts/unicycle_node/library.h5 --processes 2",
    "sagemp check certificate.h5 --json | jq .answer",
)


def check(
    file: Annotated[Path, typer.Argument(help="A certificate or a library, as somebody gave it to you.")],
    as_json: Json = False,
    processes: Annotated[int, typer.Option(min=1, help="Worker processes that share the cells.")] = 1,
) -> None:
    """Prove a certificate or a library again, in ball arithmetic, from the file alone.

    Nothing in the file is believed: see docs/certificates.md for what is proved and what is trusted. Exit code: 0 if
    all references are proved, 10 if a counterexample in the file is, 5 if less is, 2 if the file is damaged or changed.
    """
    import torch

    from sagemp_cli.checker.check import check as prove
    from sagemp_cli.cli.console import console_progress

    torch.set_num_threads(1)
    report = prove(file, processes=processes, progress=console_progress())
    typer.echo(json.dumps(as_data(report), indent=2) if as_json else printable("\n".join(as_lines(report))))
    raise typer.Exit(ANSWER_CODES[report.answer])


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
    took = f"checked in {report.seconds:.2f} s"
    lines.append(f"{took}; the proof took {report.proof_seconds:.2f} s" if report.proof_seconds > 0 else took)
    return lines


def _line(f: Finding, what: str, *, falsified: bool = False) -> str:
    if falsified and f.claimed == "UNSAFE":  # a file is FALSIFIED only if each of these has a proved counterexample
        return f"  {what} {f.reference}: UNSAFE: its counterexample is proved"
    if not f.proved:
        verb = "NOT PROVED" if f.claimed == "SAFE" else f.claimed
        return f"  {what} {f.reference}: {verb}: {f.reason}"
    near = min(f.clearance, key=f.clearance.__getitem__)
    goal = min(f.goal_margin, key=f.goal_margin.__getitem__, default=None)
    inside = f", ends {f.goal_margin[goal]:.3g} inside the goal ({goal})" if goal else ""
    return f"  {what} {f.reference}: proved, keeps {f.clearance[near]:.3g} m from {near}{inside}"


def as_data(report: Report) -> dict[str, Any]:
    """The same as plain data."""
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
