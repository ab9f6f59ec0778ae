"""What a certificate says, for people, for machines and as an exit code."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sagemp_cli.errors import ANSWER_CODES, ArtifactError, UsageError

if TYPE_CHECKING:
    from sagemp_cli.storage import Artifact, Certificate


def read_certificate(path: Path) -> Artifact[Certificate]:
    """The certificate in a file.

    Raises:
        ArtifactError: not a certificate, or one with a verdict that does not exist.
    """
    from sagemp_cli.storage import Certificate, read_artifact

    artifact = read_artifact(path, Certificate)
    if artifact.record.verdict not in ANSWER_CODES:
        raise ArtifactError(
            f"{path}: /data/verdict is '{artifact.record.verdict}', known are {', '.join(ANSWER_CODES)}"
        )
    if artifact.record.tubes.between not in ("segments", "continuous", "samples"):
        raise ArtifactError(
            f"{path}: /data/tubes/between is '{artifact.record.tubes.between}'; known: segments, continuous, samples"
        )
    return artifact


def rechecked(certificate: Artifact[Certificate]) -> str:
    """That a file's verdict still fits its own tubes, scene and counterexamples, in words; or that nobody looked.

    Raises:
        ArtifactError: it does not fit.
    """
    try:
        from sagemp_cli.checker.check import recheck
    except UsageError as e:
        return f"its verdict was not checked again ({e})"
    wrong = recheck(certificate.path)
    if wrong:
        raise ArtifactError(
            f"{certificate.path}: says {certificate.record.verdict}, but {wrong}; "
            f"it was changed or damaged, remake it with 'sagemp verify --overwrite'"
        )
    return "tubes, scene and goal were checked again; 'sagemp check' proves the reach sets as well"


def exit_code(certificate: Artifact[Certificate]) -> int:
    """0 certified, 10 falsified, 5 unknown."""
    return ANSWER_CODES[certificate.record.verdict]


def as_lines(certificate: Artifact[Certificate]) -> list[str]:
    """The verdict and what decided it, where the files are."""
    data = as_json(certificate)
    what = f"experiment {data['experiment']}, K = {data['horizon']}, {data['propagator']}"
    cells = f"{data['cells']} cell{'s' * (data['cells'] != 1)}"
    counted = f"{data['certified']} of {len(data['references'])} references certified, {cells}"
    lines = [f"{data['verdict']}: {counted} ({what}{'' if data['rigorous'] else ', rounding not included'})"]
    for i, item in enumerate(data["references"]):
        if item["verdict"] == "SAFE":
            near = f", keeps {item['clearance']:.3g} m from {item['nearest']}" if item["nearest"] else ""
            lines.append(f"  reference {i}: SAFE {data['holds']}{near}")
        else:
            lines.append(f"  reference {i}: {item['verdict']} at {item['time']} ({item['constraint']})")
    if data["lag"] is not None:
        lines.append(f"  control: {data['lag']}")
    if data["stand_in"]:
        lines.append(f"  plans: of a {data['stand_in']}")
    if data["learned"] is not None:
        lines += _learned_lines(data["learned"])
    lines += [
        f"  controls: {c['control']} asks for {c['lower']:.3g} to {c['upper']:.3g} {c['unit']}, beyond its limits"
        f" {c['limits'][0]:.3g} to {c['limits'][1]:.3g}; the proof holds for actuators that follow"
        for c in data["controls"]
        if not c["within"]
    ]
    lines += [
        f"  counterexample: reference {c['reference']}, {c['kind']} at {c['time']} ({c['constraint']}),"
        f" {c['depth']:.3g} deep"
        for c in data["counterexamples"]
    ]
    if data["samples"] is not None:
        s = data["samples"]
        lines.append(f"  further plans of the planner: {s['certified']} of {s['drawn']} certify too (seed {s['seed']})")
    lines.append(f"certificate {data['certificate']}")
    if data["verdict"] == "VERIFIED" and not data["checkable"]:
        recorded = f"propagator '{data['propagator']}' records no relaxations, 'affine' does"
        lines.append(f"  nobody else can check it: {recorded}")
    if data["figure"]:
        lines.append(f"figure      {data['figure']}")
    return lines


def _learned_lines(learned: dict[str, Any]) -> list[str]:
    """What the verdict of a learned robot is about, and what is proved of its analytical model."""
    lines = [f"  robot: a network learned from {learned['model']}; the verdict is about the network"]
    true = learned["true_model"]
    if true is None:
        return lines
    found = ", ".join(true["verdicts"]) if len(true["verdicts"]) < 9 else f"{true['certified']} of {true['of']} SAFE"
    hint = "" if true["certified"] == true["of"] else "; more cells may prove it (verify.true_model.partitions)"
    lines.append(f"  {learned['model']} itself: {found} ({true['cells']} cells){hint}")
    if true["deviation"] is not None:
        most = ", ".join(f"{d['largest']:.2g} {d['unit']} ({d['state']})" for d in true["deviation"])
        late = ", ".join(f"{d['at_end']:.2g}" for d in true["deviation"])
        near = "" if true["clearance"] is None else f"; keeps {true['clearance']:.3g} m from {true['nearest']}"
        lines.append(f"    proved deviation of the network, folded into w: at most {most}; at the end {late}{near}")
    return lines


def as_json(certificate: Artifact[Certificate]) -> dict[str, Any]:
    """The same as plain data."""
    from sagemp_cli.pipeline.models import stand_in
    from sagemp_cli.sets.between import Between, moment

    record, tubes = certificate.record, certificate.record.tubes
    dt = record.loop.dt
    figure = certificate.path.with_suffix(".png")
    references = []
    for i, verdict in enumerate(tubes.verdict):
        clearance = tubes.clearance[i]
        nearest = int(clearance.argmin()) if len(clearance) and math.isfinite(clearance.min()) else None
        references.append(
            {
                "verdict": verdict,
                "step": None if tubes.step[i] < 0 else int(tubes.step[i]),
                "fraction": None if tubes.step[i] < 0 else float(tubes.fraction[i]),
                "time": None if tubes.step[i] < 0 else moment(int(tubes.step[i]), float(tubes.fraction[i]), dt),
                "constraint": tubes.constraint[i],
                "clearance": None if nearest is None else float(clearance[nearest]),
                "nearest": None if nearest is None else tubes.constraint_names[nearest],
            }
        )
    return {
        "verdict": record.verdict,
        "exit_code": exit_code(certificate),
        "experiment": certificate.header.experiment,
        "stand_in": stand_in(certificate.header.config) or None,
        "between": tubes.between,
        "holds": Between(tubes.between).words,
        "horizon": int(tubes.tube_lower.shape[1] - 1),
        "propagator": tubes.propagator,
        "rigorous": tubes.rigorous,
        "checkable": tubes.relaxations is not None,
        "cells": len(tubes.cell_reference),
        "certified": sum(v == "SAFE" for v in tubes.verdict),
        "references": references,
        "controls": _controls(certificate),
        "lag": None if record.loop.lag is None else lag_words(record.loop.lag.tolist()),
        "learned": _learned(certificate),
        "counterexamples": [
            {
                "reference": c.reference,
                "kind": c.kind,
                "step": c.step,
                "fraction": c.fraction,
                "time": moment(c.step, c.fraction, dt),
                "constraint": c.constraint,
                "depth": c.depth,
            }
            for c in record.counterexamples
        ],
        "falsifier_rollouts": record.falsifier_rollouts,
        "samples": None if record.samples is None else dataclasses.asdict(record.samples),
        "seconds": certificate.header.seconds,
        "certificate": str(certificate.path),
        "figure": str(figure) if figure.exists() else None,
    }


def _controls(certificate: Artifact[Certificate]) -> list[dict[str, Any]]:
    """Range of each control over all certified tubes, beside the robot's limits (empty if nothing is certified).

    Nothing in the loop enforces limits: the paper penalises them in training; the proof is about the model as it is.
    """
    from sagemp_cli.config.binding import build

    tubes = certificate.record.tubes
    safe = [i for i, verdict in enumerate(tubes.verdict) if verdict == "SAFE"]
    if not safe:
        return []
    robot: Any = build(certificate.header.config["dynamics"], "dynamics")
    lower, upper = tubes.control_lower[safe].min((0, 1)), tubes.control_upper[safe].max((0, 1))
    ranges = zip(robot.control_names, robot.control_units, lower.tolist(), upper.tolist(), strict=True)
    return [
        {
            "control": name,
            "unit": unit,
            "lower": least,
            "upper": most,
            "limits": limits,
            "within": limits[0] <= least and most <= limits[1],
        }
        for (name, unit, least, most), limits in zip(
            ranges,
            ([*pair] for pair in zip(robot.control_lower.tolist(), robot.control_upper.tolist(), strict=True)),
            strict=True,
        )
        if math.isfinite(least) and math.isfinite(most)
    ]


def lag_words(lag: Sequence[Sequence[float]]) -> str:
    """Bounds of a control's delay and of its measurement's jitter, in seconds, in words."""

    def seconds(least: float, most: float) -> str:
        return f"{most:g} s" if least == most else f"{least:g} to {most:g} s" if least else f"up to {most:g} s"

    (late, old), words = lag, []
    if late[1]:
        words.append(f"{seconds(*late)} late")
    if old[1]:
        words.append(f"of a state {seconds(*old)} old")
    return ", ".join(words)


def _learned(certificate: Artifact[Certificate]) -> dict[str, Any] | None:
    """Of a learned robot what is proved of its analytical model; None for a robot of formulas."""
    from sagemp_cli.config.binding import build

    robot: Any = build(certificate.header.config["dynamics"], "dynamics")
    if robot.analytical is robot:
        return None
    found: dict[str, Any] = {"model": type(robot.analytical).__name__, "true_model": None}
    true = certificate.record.true_model
    if true is None:
        return found
    verdicts, clearance = list(true.tubes.verdict), true.tubes.clearance
    safe = [i for i, verdict in enumerate(verdicts) if verdict == "SAFE"]
    deviation, nearest = None, None
    if safe:
        largest, at_end = true.deviation[safe].max((0, 1)), true.deviation[safe, -1].max(0)
        per = "/s" if robot.disturbance == "derivative" else ""
        deviation = [
            {"state": name, "unit": f"{unit}{per}", "largest": float(most), "at_end": float(late)}
            for name, unit, most, late in zip(robot.state_names, robot.state_units, largest, at_end, strict=True)
        ]
        nearest = int(clearance[safe].min(0).argmin()) if clearance.shape[1] else None
    found["true_model"] = {
        "verdicts": verdicts,
        "certified": len(safe),
        "of": len(verdicts),
        "cells": len(true.tubes.cell_reference),
        "deviation": deviation,
        "clearance": None if nearest is None else float(clearance[safe].min(0)[nearest]),
        "nearest": None if nearest is None else true.tubes.constraint_names[nearest],
    }
    return found
