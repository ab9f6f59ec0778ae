"""``sagemp prove``."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sagemp_cli.cli.command import examples, printable
from sagemp_cli.cli.options import Json, Overwrite, TimeLimit
from sagemp_cli.errors import ANSWER_CODES, UsageError

if TYPE_CHECKING:
    from sagemp_cli.sets import Box
    from sagemp_cli.verification.strangers_loop import LoopProof

EXAMPLES = examples(
    "sagemp prove my_loop.py:step --start 0.9:1.1,0 --horizon 40 --goal -0.1:0.1,:",
    "sagemp prove my_loop.py:step --start 1:1.2,0:0.2 --disturbance -0.01:0.01 --horizon 20 --scene scene.yaml",
    "sagemp prove my_loop.py:step --start 1:1.2,0:0.2 --horizon 20 --names angle,rate --units rad,rad/s --dt 0.05",
    "sagemp check my_loop_step.h5",
    "sagemp prove my_robot.py:Robot --network controller.onnx",
)


def prove(
    target: Annotated[
        str, typer.Argument(metavar="FILE:NAME", help="A step in torch: a function, module or loop of a Python file.")
    ],
    start: Annotated[
        str | None,
        typer.Option(
            metavar="BOX",
            help="X_I: one interval or number for each state, e.g. 0.9:1.1,0; an ODE may have its own.",
            show_default=False,
        ),
    ] = None,
    horizon: Annotated[
        int | None,
        typer.Option(metavar="K", min=1, help="Number of steps; a loop may have its own.", show_default=False),
    ] = None,
    disturbance: Annotated[
        str | None,
        typer.Option(metavar="BOX", help="W, anew at every step; left out if there is none.", show_default=False),
    ] = None,
    scene: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="YAML with workspace, obstacles and goal, or some of them.", show_default=False
        ),
    ] = None,
    goal: Annotated[
        str | None,
        typer.Option(
            metavar="BOX", help="Where the state must be at step K; 0: or : have no end there.", show_default=False
        ),
    ] = None,
    position: Annotated[
        str | None,
        typer.Option(
            metavar="STATES", help="The states that the scene is about; its first ones by default.", show_default=False
        ),
    ] = None,
    between: Annotated[
        str,
        typer.Option(
            metavar="WHEN",
            help="When the scene is to be kept: segments, on the straight lines between the samples too (what a "
            "forward-Euler step moves along), or samples, of a step that is no such motion.",
        ),
    ] = "segments",
    names: Annotated[str | None, typer.Option(metavar="WORDS", help="Of the states.", show_default=False)] = None,
    units: Annotated[str | None, typer.Option(metavar="WORDS", help="Of the states.", show_default=False)] = None,
    dt: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="Between two samples, for the figure.", show_default=False)
    ] = None,
    partitions: Annotated[
        str, typer.Option(metavar="CELLS", help="A total (4), counts per uncertain state (2x2), or auto.")
    ] = "auto",
    budget: Annotated[int, typer.Option(min=1, help="Cells at most with auto.")] = 64,
    propagator: Annotated[str, typer.Option(help="affine, best, crown, interval or auto_lirpa.")] = "affine",
    seed: Annotated[int, typer.Option(min=0, help="Of the attacks on a claim that is not proved.")] = 0,
    network: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Of an ODE: an ONNX file, which its control(x, network) gets.", show_default=False
        ),
    ] = None,
    period: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS", help="Of an ODE: between two samples; it may have its own.", show_default=False
        ),
    ] = None,
    substeps: Annotated[
        int | None,
        typer.Option(
            min=1, help="Of an ODE: parts of a period, a power of two; as needed by default.", show_default=False
        ),
    ] = None,
    order: Annotated[
        int | None,
        typer.Option(
            min=1, help="Of an ODE: degree of the Taylor polynomials; as needed by default.", show_default=False
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The certificate; FILE_NAME.h5 here by default.", show_default=False),
    ] = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
    time_limit: TimeLimit = None,
) -> None:
    """Prove that a step of your own, written in torch, stays safe from all starts and reaches its goal.

    The step is [bold]step(x, w)[/bold], [bold]step(k, x, w)[/bold], or [bold]step(x)[/bold] without disturbance. It
    is recorded as a program, which is bounded, judged and attacked. Writes a certificate, which carries the program,
    and a figure beside it. Without a scene and a goal it proves that the states stay in a bounded tube. Exit code: 0
    certified, 10 falsified, 5 unknown.

    An object or a class with [bold]rate(x, u)[/bold] and [bold]control(x)[/bold] is a robot as an ODE whose control is
    held for a period: what is proved holds at all times, between the samples too. It may say its period, horizon,
    start, disturbance, state_names and requirements itself.
    """
    import torch

    from sagemp_cli.cli.ode_verdict import ode_as_data, ode_as_lines
    from sagemp_cli.cli.time_limit import time_limit as limited
    from sagemp_cli.config.folders import mapping_in
    from sagemp_cli.plugins.loading import load_object
    from sagemp_cli.stages.prove import prove as proved
    from sagemp_cli.stages.prove_ode import is_plant, plant_of, prove_ode

    torch.set_num_threads(1)
    step, name = load_object(target)
    path = Path(f"{name}.h5") if output is None else output
    boxes = {
        "start": None if start is None else _box("--start", start),
        "disturbance": None if disturbance is None else _box("--disturbance", disturbance),
        "goal": None if goal is None else _box("--goal", goal, open_ends=True),
    }
    common = {
        "scene": None if scene is None else mapping_in(scene, f"scene file {scene}"),
        "position": None if position is None else _words(position),
        "state_names": None if names is None else _words(names),
        "state_units": None if units is None else _words(units),
        "propagator": propagator,
        "partitions": int(partitions) if partitions.isdigit() else partitions,
        "budget": budget,
        "seed": seed,
        "name": name,
    }
    of_ode = {"network": network, "period": period, "substeps": substeps, "order": order}
    if is_plant(step):
        of_steps = {"dt": dt, "between": None if between == "segments" else between}
        _refuse(of_steps, f"{target} is an ODE, judged at all times")
        with limited(time_limit):
            found = prove_ode(
                plant_of(step, network),
                **boxes,
                **common,
                horizon=horizon,
                period=period,
                substeps=substeps,
                order=order,
                certificate=path,
                overwrite=overwrite,
                figure=path.with_suffix(".png"),
            )
        said = ode_as_data(found) | {"certificate": str(path), "figure": str(path.with_suffix(".png"))}
        typer.echo(json.dumps(said, indent=2) if as_json else printable("\n".join(ode_as_lines(said))))
        raise typer.Exit(ANSWER_CODES[str(found.answer)])
    _refuse(of_ode, f"{target} is a step, no ODE: it has no rate(x, u)")
    if boxes["start"] is None:
        raise UsageError("--start is missing: X_I, one interval or number for each state")
    with limited(time_limit):
        proof = proved(
            step,
            horizon=horizon,
            **boxes,
            **common,
            between=between,
            dt=dt,
            certificate=path,
            overwrite=overwrite,
        )
    data = as_data(proof, dt) | {"certificate": str(path), "figure": str(path.with_suffix(".png"))}
    typer.echo(json.dumps(data, indent=2) if as_json else printable("\n".join(as_lines(data))))
    raise typer.Exit(ANSWER_CODES[str(proof.answer)])


def _refuse(options: dict[str, Any], why: str) -> None:
    """Options that mean nothing here are an error, never ignored."""
    for name, value in options.items():
        if value is not None:
            raise UsageError(f"--{name} means nothing here: {why}")


def as_data(proof: LoopProof, dt: float | None = None) -> dict[str, Any]:
    """What was found out, as plain data; ``dt``: seconds between samples, if they are known."""
    v, claim, example = proof.verification, proof.claim, proof.counterexample
    verdict = v.verdicts[0]
    clearance = dict(zip(v.constraint_names, v.clearance[0].tolist(), strict=True))
    return {
        "verdict": str(proof.answer),
        "exit_code": ANSWER_CODES[str(proof.answer)],
        "why": verdict.described(dt),
        "between": str(v.between),
        "holds": v.between.words,
        "horizon": proof.loop.horizon,
        "cells": len(v.cells.lower),
        "propagator": v.propagator,
        "rigorous": v.rigorous,
        "checkable": v.recording is not None,
        "clearance": {name: value if math.isfinite(value) else None for name, value in clearance.items()},
        "at_the_end": [
            {"state": name, "lower": low, "upper": high}
            for name, low, high in zip(
                claim.state_names, proof.tube.lower[-1].tolist(), proof.tube.upper[-1].tolist(), strict=True
            )
        ],
        "counterexample": None
        if example is None
        else {
            "step": example.step,
            "fraction": example.fraction,
            "depth": example.depth,
            "start": example.start.tolist(),
        },
        "unproved_violation": None if proof.unproved is None else proof.unproved.depth,
        "asks": claim.asks,
        "notes": list(v.notes),
        "seconds": float(v.seconds.sum()),
    }


def as_lines(data: dict[str, Any]) -> list[str]:
    """The same for people."""
    cells = f"{data['cells']} cell{'s' * (data['cells'] != 1)}"
    rounding = "" if data["rigorous"] else ", rounding not included"
    lines = [f"{data['verdict']}: {data['why']} (K = {data['horizon']}, {cells}, {data['propagator']}{rounding})"]
    if not data["asks"]:
        lines.append("  no scene and no goal were given: what is proved is the tube")
    if data["clearance"] and data["between"] == "samples":
        lines.append("  between the samples nothing is claimed: --between segments claims it of straight lines")
    if data["verdict"] == "VERIFIED":
        lines += [
            f"  keeps {d:.3g} from {name} {data['holds']}" for name, d in data["clearance"].items() if d is not None
        ]
    ends = ", ".join(f"{s['state']} {s['lower']:.4g} to {s['upper']:.4g}" for s in data["at_the_end"])
    lines.append(f"  at step {data['horizon']}: {ends}")
    if data["counterexample"] is not None:
        start = ", ".join(f"{v:.6g}" for v in data["counterexample"]["start"])
        lines.append(f"  counterexample: from ({start}), {data['counterexample']['depth']:.3g} deep")
    if data["unproved_violation"] is not None:
        lines.append(
            f"  a rollout breaks the claim by {data['unproved_violation']:.3g} in float64, which rigorous arithmetic "
            "does not prove: it may be rounding"
        )
    lines += [f"  {note}" for note in data["notes"]]
    lines += [f"certificate {data['certificate']}", f"figure      {data['figure']}"]
    if data["verdict"] == "VERIFIED" and not data["checkable"]:
        lines.append("  nobody else can check it: only 'affine' records its relaxations, of steps that are alike")
    return lines


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",")]


def _box(option: str, text: str, *, open_ends: bool = False) -> Box:
    """``lower:upper`` for each dimension, or a number; with open ends either may be missing."""
    import torch

    from sagemp_cli.sets import Box

    lower, upper = [], []
    for part in text.split(","):
        first, colon, second = part.strip().partition(":")
        ends = []
        for end, missing in ((first, -math.inf), (second if colon else first, math.inf)):
            try:
                value = missing if open_ends and colon and not end.strip() else float(end)
            except ValueError:
                raise UsageError(f"{option}: '{part.strip()}' is no number and no interval such as 0.9:1.1") from None
            ends.append(value)
        if math.isnan(ends[0]) or math.isnan(ends[1]) or ends[0] > ends[1]:
            raise UsageError(f"{option}: '{part.strip()}' must be lower:upper")
        lower.append(ends[0])
        upper.append(ends[1])
    return Box(torch.tensor(lower, dtype=torch.float64), torch.tensor(upper, dtype=torch.float64))
