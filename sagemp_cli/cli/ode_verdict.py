"""How a verdict in continuous time is told, to people and as JSON."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from sagemp_cli.errors import ANSWER_CODES

if TYPE_CHECKING:
    from sagemp_cli.verification.continuous.proof import OdeProof


def ode_as_data(proof: OdeProof) -> dict[str, Any]:
    """What was found out, as plain data; numbers that are not finite are null."""
    example = proof.violation
    return {
        "verdict": str(proof.answer),
        "exit_code": ANSWER_CODES[str(proof.answer)],
        "time": "continuous",
        "period": proof.loop.period,
        "horizon": proof.loop.horizon,
        "cells": proof.cells,
        "divisions": [{"substeps": d.substeps, "order": d.order} for d in proof.divisions],
        "propagator": proof.propagator,
        "bounded": proof.bounded,
        "requirements": [
            {"name": v.name, "answer": str(v.answer), "margin": _number(v.margin), "at": _number(v.time)}
            for v in proof.verdicts
        ],
        "at_the_end": None
        if not proof.pieces
        else [
            {"lower": _number(low), "upper": _number(high)}
            for low, high in zip(proof.tube.lower[-1].tolist(), proof.tube.upper[-1].tolist(), strict=True)
        ],
        "counterexample": None
        if example is None
        else {
            "requirement": example.requirement,
            "at": example.time,
            "depth": example.depth,
            "start": example.start.tolist(),
            "signal": example.signal.tolist(),
            "proved": example.proved,
        },
        "notes": list(proof.notes),
        "seconds": proof.seconds,
    }


def ode_as_lines(data: dict[str, Any]) -> list[str]:
    """The same for people."""
    cells = f"{data['cells']} cell{'s' * (data['cells'] != 1)}"
    cut = ", ".join(f"{d['substeps']} parts a period of order {d['order']}" for d in data["divisions"])
    how = ", ".join(part for part in (cells * bool(data["cells"]), cut, data["propagator"]) if part)
    lines = [f"{data['verdict']}: {data['horizon']} periods of {data['period']:g} s, at all times ({how})"]
    if not data["requirements"]:
        lines.append(
            "  nothing was asked for: what is proved is the tube" if data["bounded"] else "  the tube is not bounded"
        )
    example = data["counterexample"]
    lines += [f"  {one['name']}: {_told(one, data['verdict'])}" for one in data["requirements"]]
    if data["at_the_end"] is not None and all(e["lower"] is not None for e in data["at_the_end"]):
        lines.append("  at the end: " + ", ".join(f"{e['lower']:.4g} to {e['upper']:.4g}" for e in data["at_the_end"]))
    if example is not None:
        start = ", ".join(f"{v:.6g}" for v in example["start"])
        if example["proved"]:
            lines.append(f"  counterexample: from ({start}), {example['depth']:.3g} deep, an enclosure of it proves it")
        else:
            lines.append(
                f"  a rollout from ({start}) breaks '{example['requirement']}' by {example['depth']:.3g} in float64, "
                f"which no enclosure proves: it may be rounding"
            )
    lines += [f"  {note}" for note in data["notes"]]
    lines += [f"certificate {data['certificate']}", f"figure      {data['figure']}"]
    return lines


def _told(one: dict[str, Any], verdict: str) -> str:
    if one["answer"] == "VERIFIED":
        return f"holds, by {one['margin']:.4g} at least (at {one['at']:.4g} s)"
    if one["answer"] == "FALSIFIED":
        return f"is broken at {one['at']:.4g} s"
    if verdict == "FALSIFIED" and one["margin"] is None:
        return "was not tried: another requirement is broken"
    known = "nothing is known" if one["margin"] is None else f"margin {one['margin']:.4g}"
    return f"not proved, first at {one['at']:.4g} s ({known})"


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
