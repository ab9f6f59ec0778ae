"""What a checked file proves of an ODE beside what a robot of one's own asks for: every difference."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from sagemp_cli.checker.balls import BITS, arb, ball, ctx
from sagemp_cli.checker.check import Report, sides
from sagemp_cli.checker.document import Document
from sagemp_cli.checker.points import outputs_at
from sagemp_cli.checker.program import Program
from sagemp_cli.dynamics.lag import Lag
from sagemp_cli.errors import UsageError
from sagemp_cli.pipeline.against import Difference, lag_differences
from sagemp_cli.scenes.requirements import Formula
from sagemp_cli.sets import Box
from sagemp_cli.stages.prove_ode import Plant
from sagemp_cli.verification.continuous.judging import in_periods

_POINTS = 64
_TOLERANCE = 1e-9


def plant_differences(report: Report, plant: Plant) -> list[Difference]:
    """What differs between a checked file and a robot.

    Sets, period and horizon are compared exactly; a wider X_I or W than asked for covers it. The control of such a
    robot is of its state alone and there at once: a file about one that is always late does not say so. Functions,
    those of the requirements too, are compared with the file's programs at points of the tube, which finds differences
    and proves nothing.

    Raises:
        UsageError: the file is not about an ODE, or a function fails.
    """
    document = report.document
    if document.ode is None:
        raise UsageError("the file is about a step in discrete time, and cannot be compared with an ODE")
    found = [] if report.answer == "VERIFIED" else [Difference("verdict", report.answer, "VERIFIED", covers=False)]
    names = document.state_names if plant.state_names is None else plant.state_names
    if plant.start is None or len(names) != len(document.state_names) or plant.start.dim != len(names):
        asked = "no start" if plant.start is None else f"{plant.start.dim} states"
        return [*found, Difference("states", f"{len(document.state_names)} states", asked, covers=False)]
    if tuple(names) != document.state_names:
        found.append(Difference("states", ", ".join(document.state_names), ", ".join(names), covers=False))
    none = torch.zeros(plant.start.dim, dtype=torch.float64)
    with ctx.workprec(BITS), torch.no_grad():
        found += _box("X_I", document, 0, plant.start)
        found += _box("W", document, 1, Box(none, none) if plant.disturbance is None else plant.disturbance)
        if plant.period != document.dt:
            found.append(Difference("period", f"{document.dt!r} s", f"{plant.period!r} s", covers=False))
        if plant.horizon != document.horizon:
            found.append(Difference("K", str(document.horizon), str(plant.horizon), covers=False))
        found += lag_differences(document.ode.lag, Lag())
        points = _points(document)
        if document.lookahead:
            proved = f"of the state and of {document.lookahead} points of a reference"
            found.append(Difference("control", proved, "of the state alone", covers=False))
        else:
            found += _function("control", document.programs[0], points, plant.control, numbers=False)
        found += _function("ODE", document.ode.rate, points, plant.rate, numbers=True)
        for requirement in plant.requirements:
            formula = requirement.formula(names)
            if not any(_same(document, i, formula, points) for i in range(len(document.requirements))):
                what = f"requirement '{formula.name}'"
                found.append(Difference(what, "none like it", "that it holds", covers=False))
    return found


def _box(what: str, document: Document, which: int, asked: Box) -> Iterator[Difference]:
    pairs = list(zip(sides(document.sets[which]), asked.lower.tolist(), asked.upper.tolist(), strict=True))
    if not all(low <= ball(a) and ball(b) <= high for (low, high), a, b in pairs):
        texts = [f"[{float(low):.6g}, {float(high):.6g}]" for (low, high), _, _ in pairs]
        yield Difference(what, ", ".join(texts), ", ".join(f"[{a:.6g}, {b:.6g}]" for _, a, b in pairs), covers=False)


def _points(document: Document) -> list[tuple[np.ndarray, np.ndarray]]:
    """States of the tube and controls of its bounds."""
    rng, tubes, found = np.random.default_rng(0), document.tubes, []
    for _ in range(_POINTS):
        k, c = int(rng.integers(document.horizon)), int(rng.integers(len(tubes["tube_lower"])))
        boxes = (("tube", c), ("control", 0))
        x, u = (
            rng.uniform(
                *(np.nan_to_num(tubes[f"{name}_{s}"][i, k], posinf=1e3, neginf=-1e3) for s in ("lower", "upper"))
            )
            for name, i in boxes
        )
        found.append((x, u))
    return found


def _function(what: str, program: Program, points: Any, function: Any, *, numbers: bool) -> Iterator[Difference]:
    """A program beside a function of the state, and of the control if it takes numbers."""
    worst = 0.0
    for x, u in points:
        own = _values(program, x, u if numbers else np.zeros(0), "next" if numbers else "control")
        try:
            given = function(*map(torch.from_numpy, (x, u) if numbers else (x,)))
            given = np.asarray(torch.as_tensor(given).detach().to(torch.float64))
        except Exception as e:  # a stranger's code may raise anything
            raise UsageError(f"{what} cannot be called: {' '.join(str(e).split())[:200]}") from None
        worst = max(worst, _apart(own, given))
    if not worst <= _TOLERANCE:
        yield Difference(
            what, f"another one, by up to {worst:.3g} at {_POINTS} points", "that of the robot", covers=False
        )


def _values(program: Program, x: np.ndarray, numbers: np.ndarray, output: str) -> np.ndarray:
    inputs = {"state": x, "disturbance": np.zeros(program.disturbances), "numbers": numbers}
    out = outputs_at(program, {name: [arb(float(v)) for v in values] for name, values in inputs.items()})
    return np.array([float(v) for v in out[output]])


def _apart(own: np.ndarray, given: np.ndarray) -> float:
    if own.shape != given.shape:
        return float("inf")
    both = np.isnan(own) & np.isnan(given)
    return float(np.nan_to_num(np.where(both, 0.0, np.abs(own - given) / (1.0 + np.abs(given))), nan=np.inf).max())


def _same(document: Document, i: int, formula: Formula, points: Any) -> bool:
    """Whether a requirement of the file asks at least for what a formula does, at points."""
    one, dt = document.requirements[i], document.dt
    assert dt is not None
    first, last = (in_periods(t, dt, document.horizon) for t in (formula.first, formula.last))
    if not (one.first <= first and last <= one.last) or (formula.strict and not one.strict):
        return False
    if one.every is not formula.every and one.margins.controls > 1:
        return False
    return all(
        _apart(
            _values(one.margins, x, np.zeros(0), "control"), np.atleast_1d(formula.margins(torch.from_numpy(x)).numpy())
        )
        <= _TOLERANCE
        for x, _ in points
    )
