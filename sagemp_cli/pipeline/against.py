"""What a checked file proves beside what a config asks for: every difference, and whether the proof covers it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from sagemp_cli.checker.balls import BITS, ball, ctx
from sagemp_cli.checker.between import CONTINUOUS, SEGMENTS
from sagemp_cli.checker.check import Report, sides
from sagemp_cli.checker.claim import disturbance_names
from sagemp_cli.checker.clearance import clearances, goal_margins
from sagemp_cli.checker.document import Document
from sagemp_cli.checker.lag import Lag as Proved
from sagemp_cli.checker.lines import lines_of
from sagemp_cli.checker.points import outputs_at
from sagemp_cli.checker.program import Program
from sagemp_cli.checker.scene import SafeSet, SetOfConfig
from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.dynamics.lag import Lag
from sagemp_cli.dynamics.learned import Learned
from sagemp_cli.pipeline.problem import robot_of

_POINTS = 64
_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Difference:
    """One thing that is not the same.

    Attributes:
        what: X_I, W, K, the scene and so on.
        proved, asked: both, in words.
        covers: whether what is proved says what is asked as well.
    """

    what: str
    proved: str
    asked: str
    covers: bool


def differences(report: Report, config: Mapping[str, Any]) -> list[Difference]:
    """What differs between a checked file and a composed config.

    Sets and scenes are compared exactly: a wider X_I or W than asked for covers it, and the stored tubes, which are
    proved, are held against the scene that is asked for. The robot's formulas are compared with the program at points
    of the tube, which finds differences and proves nothing; a network has no formulas to compare with.

    Raises:
        ConfigError: the config's robot cannot be built.
    """
    document, robot = report.document, robot_of(config)
    safe_ones = [f.reference for f in report.findings if f.proved]
    n = len(document.state_names)
    found = [] if report.answer == "VERIFIED" else [Difference("verdict", report.answer, "VERIFIED", covers=False)]
    names = tuple(robot.state_names), tuple(robot.state_units), tuple(robot.position)
    stated = document.state_names, document.state_units, document.position
    if names != stated:
        return [*found, Difference("states", _words(stated), _words(names), covers=False)]
    with ctx.workprec(BITS):
        wanted = SetOfConfig.of("start", config["start"], n), SetOfConfig.of("disturbance", config["disturbance"], n)
        found += _boxes("X_I", document, document.sets[0], wanted[0], safe_ones)
        found += _boxes("W", document, document.sets[1], wanted[1], safe_ones)
        asked = CONTINUOUS if robot.continuous else SEGMENTS
        if document.between != asked:
            found.append(Difference("between", document.between, asked, covers=False))
        if config["horizon"] != document.horizon:
            found.append(Difference("K", str(document.horizon), str(config["horizon"]), covers=False))
        found += _scene(document, SafeSet.of(config["scene"]), safe_ones)
    found += _model(document, robot)
    found += _limits(document, robot, safe_ones)
    return found


def _words(stated: tuple[Any, ...]) -> str:
    names, units, position = stated
    return f"{', '.join(f'{a} ({b})' for a, b in zip(names, units, strict=True))}, position {list(position)}"


def _boxes(
    what: str, document: Document, given: SetOfConfig, wanted: SetOfConfig, safe_ones: Sequence[int]
) -> Iterator[Difference]:
    """A set that is proved beside the one that is asked for."""
    tubes = document.tubes
    stored = (
        [(tubes["start_lower"][r], tubes["start_upper"][r]) for r in safe_ones]
        if what == "X_I"
        else [(tubes["disturbance_lower"], tubes["disturbance_upper"])]
    )
    if given == wanted:
        return
    ends = sides(wanted)
    covers = bool(safe_ones) and all(
        ball(a) <= low and high <= ball(b) for box in stored for a, b, (low, high) in zip(*box, ends, strict=True)
    )
    names = document.state_names if what == "X_I" else disturbance_names(document)
    pairs = list(zip(names, *given.corners(), *wanted.corners(), strict=True))
    other = [p for p in pairs if p[1:3] != p[3:5]] or pairs
    yield Difference(
        what,
        ", ".join(f"{name} {a:.6g} to {b:.6g}" for name, a, b, _, _ in other),
        ", ".join(f"{name} {a:.6g} to {b:.6g}" for name, _, _, a, b in other),
        covers=covers,
    )


def _scene(document: Document, wanted: SafeSet, safe_ones: Sequence[int]) -> Iterator[Difference]:
    """The proved tubes held against the scene that is asked for, where it is another one."""
    given, tubes = document.safe, document.tubes
    if given == wanted:
        return
    own = np.isin(tubes["cell_reference"], safe_ones)
    lower, upper = tubes["tube_lower"][own], tubes["tube_upper"][own]
    known = bool(len(lower)) and bool(np.isfinite(lower).all() and np.isfinite(upper).all())
    apart: list[Any] = [None] * len(wanted.names)
    inside: list[Any] = [None] * lower.shape[2]
    if known:
        lines = [line for c in np.flatnonzero(own).tolist() for line in lines_of(document, c)]
        apart = clearances(wanted, lines, document.parts)
        inside = goal_margins(wanted, lower[:, -1].min(axis=0), upper[:, -1].max(axis=0))
    if given.workspace != wanted.workspace:
        covers = wanted.workspace is None or (known and bool(apart[0] > 0))
        yield Difference("workspace", _box(given.workspace), _box(wanted.workspace), covers=covers)
    before, first = {o[0]: o[1:] for o in given.obstacles}, len(wanted.names) - len(wanted.obstacles)
    for i, (name, *shape) in enumerate(wanted.obstacles):
        if before.pop(name, None) != tuple(shape):
            same = next((o for o in given.obstacles if o[0] == name), None)
            covers = known and bool(apart[first + i] > 0)
            yield Difference(f"obstacle {name}", "none" if same is None else _shape(same[1:]), _shape(shape), covers)
    for name, shape in before.items():
        yield Difference(f"obstacle {name}", _shape(shape), "none", covers=True)
    if given.goal != wanted.goal:
        covers = wanted.goal is None or (known and all(m is None or bool(m >= 0) for m in inside))
        yield Difference("goal", _box(given.goal), _box(wanted.goal), covers=covers)


def _model(document: Document, robot: Dynamics) -> Iterator[Difference]:
    """The program's step beside the robot's formulas, at points of the tube."""
    if document.dt is not None and document.dt != robot.dt:
        how = "said" if document.ode is None else "proved"
        yield Difference("between samples", f"{document.dt:.6g} s ({how})", f"{robot.dt:.6g} s", covers=False)
    if (document.ode is not None) != robot.continuous:  # said already: another kind of time
        return
    model: Dynamics = robot.analytical
    true = document.true_model
    if isinstance(robot, Learned) and true is None:
        yield Difference("step", "the network in the file", "a network learned from the formulas", covers=True)
        return
    if document.ode is not None:
        yield from lag_differences(document.ode.lag, robot.control_lag)
        yield from _rate(document, document.ode.rate, model)
        return
    program = (document if true is None else true).programs[0]
    if program.control < 0 or len(document.programs) > 1 or program.disturbances != robot.state_dim:
        yield Difference("step", "a program without a control", "the robot's formulas", covers=False)
        return
    worst = 0.0
    rng = np.random.default_rng(0)
    tubes, windows = document.tubes, document.windows(0)
    with ctx.workprec(BITS):
        for _ in range(_POINTS):
            k, c = int(rng.integers(document.horizon)), int(rng.integers(len(tubes["tube_lower"])))
            x, w = (
                rng.uniform(*np.nan_to_num([low, high], posinf=1e3, neginf=-1e3))
                for low, high in (
                    (tubes["tube_lower"][c, k], tubes["tube_upper"][c, k]),
                    (tubes["disturbance_lower"], tubes["disturbance_upper"]),
                )
            )
            inputs = {"state": x, "disturbance": w, "numbers": windows[k]}
            out = outputs_at(program, {name: [ball(v) for v in values] for name, values in inputs.items()})
            after, u = (np.array([float(v) for v in out[name]]) for name in ("next", "control"))
            exact = model.step(*map(torch.from_numpy, (x, u, w))).detach().numpy()
            worst = max(worst, _apart(after, exact))
    if not worst <= _TOLERANCE:
        yield _another("step", worst)


def lag_differences(proved: Proved | None, asked: Lag) -> Iterator[Difference]:
    """How late a control may be, beside how late it is said to be."""
    for name in ("delay", "jitter"):
        one, other = (0.0, 0.0) if proved is None else getattr(proved, name), getattr(asked, name)
        if one != other:
            words = [" to ".join(f"{v:.6g}" for v in sides) + " s" for sides in (one, other)]
            yield Difference(name, *words, covers=one[0] <= other[0] and other[1] <= one[1])


def _rate(document: Document, rate: Program, model: Dynamics) -> Iterator[Difference]:
    """The right-hand side of an ODE beside the robot's formulas, likewise."""
    if rate.numbers != model.control_dim:
        yield Difference("ODE", f"of {rate.numbers} controls", f"of {model.control_dim}", covers=False)
        return
    worst, rng, tubes = 0.0, np.random.default_rng(0), document.tubes
    boxes = [(tubes[f"{name}_lower"], tubes[f"{name}_upper"]) for name in ("tube", "control")]
    with ctx.workprec(BITS):
        for _ in range(_POINTS):
            k, c = int(rng.integers(document.horizon)), int(rng.integers(len(tubes["tube_lower"])))
            rows = c, int(tubes["cell_reference"][c])
            x, u = (
                rng.uniform(*(np.nan_to_num(side[row, k], posinf=1e3, neginf=-1e3) for side in sides))
                for row, sides in zip(rows, boxes, strict=True)
            )
            inputs = {"state": x, "disturbance": np.zeros(len(x)), "numbers": u}
            out = outputs_at(rate, {name: [ball(v) for v in values] for name, values in inputs.items()})
            found = np.array([float(v) for v in out["next"]])
            worst = max(worst, _apart(found, model.derivative(*map(torch.from_numpy, (x, u))).detach().numpy()))
    if not worst <= _TOLERANCE:
        yield _another("ODE", worst)


def _apart(found: np.ndarray, exact: np.ndarray) -> float:
    """The largest relative difference; what is a number in one of them only is infinitely far."""
    both = np.isnan(found) & np.isnan(exact)
    return float(np.max(np.nan_to_num(np.where(both, 0.0, np.abs(found - exact) / (1.0 + np.abs(exact))), nan=np.inf)))


def _another(what: str, worst: float) -> Difference:
    return Difference(what, f"another one, by up to {worst:.3g} at {_POINTS} points", "the robot's formulas", False)


def _limits(document: Document, robot: Dynamics, safe_ones: Sequence[int]) -> Iterator[Difference]:
    """Controls beyond the robot's limits: nothing asks for them to be kept, unless the tracker saturates."""
    if not safe_ones or len(document.control_names) != robot.control_dim:
        return
    tubes = document.tubes
    lower, upper = tubes["control_lower"][safe_ones].min((0, 1)), tubes["control_upper"][safe_ones].max((0, 1))
    limits = zip(robot.control_lower.tolist(), robot.control_upper.tolist(), strict=True)
    for name, a, b, (low, high) in zip(document.control_names, lower, upper, limits, strict=True):
        if a < low or b > high:
            yield Difference(
                f"control {name}", f"{a:.6g} to {b:.6g}", f"limits {low:.6g} to {high:.6g}, not to be kept", True
            )


def _box(corners: tuple[list[float], list[float]] | None) -> str:
    if corners is None:
        return "none"
    return f"{[float(f'{v:.6g}') for v in corners[0]]} to {[float(f'{v:.6g}') for v in corners[1]]}"


def _shape(shape: Sequence[Any]) -> str:
    kind, first, second = shape
    return f"ball {first}, radius {second:.6g}" if kind == "ball" else f"block {first} to {second}"
