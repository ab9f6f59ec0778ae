"""Counterexamples: a stored rollout replayed in ball arithmetic, so that the violation is proved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sagemp_cli.checker.balls import arb, ball, balls, ctx
from sagemp_cli.checker.between import SAMPLES, on_line
from sagemp_cli.checker.document import Document
from sagemp_cli.checker.points import Point, outputs_at
from sagemp_cli.checker.program import Program
from sagemp_cli.checker.scene import SafeSet
from sagemp_cli.checker.solution import PARTS, followed
from sagemp_cli.checker.unproved import Unproved

BITS = 512  # a rollout has no other errors than rounding, which the loop may amplify

Ends = Sequence[tuple[arb, arb]]


def replay(
    programs: Sequence[Program], start: Sequence[float] | Point, disturbances: Sequence[Any], windows: np.ndarray
) -> list[Point]:
    """The states of a rollout, ``x_0, ..., x_k`` for k disturbances, as balls that contain them.

    It needs nothing but programs and numbers and can stand beside any other replay.

    Args:
        programs: the step of each k.
        start: x_0, taken as exact if it is of float64 numbers.
        disturbances: w_0, ..., w_{k-1}, likewise.
        windows: numbers of each step, ``(K, g)``.
    """
    with ctx.workprec(BITS):
        states = [_exact(start)]
        for k, w in enumerate(disturbances):
            inputs = {"state": states[-1], "disturbance": _exact(w), "numbers": balls(windows[k])}
            states.append(outputs_at(programs[k], inputs)["next"])
        return states


def prove_violation(document: Document, example: Mapping[str, Any], sets: tuple[Ends, Ends], safe: SafeSet) -> str:
    """Prove that a rollout from X_I under disturbances in W leaves the safe set, misses the goal or breaks what is
    required.

    It does so at its step, or at the fraction of it that the record says, on the straight line to the next sample; in
    continuous time as a solution under a disturbance that is constant on equal pieces of every period.

    The start and the disturbances are taken from the record as exact numbers, nothing else is. The boxes stored beside
    the tubes may be larger than X_I and W: from there everything is moved into the nearest point of those.

    Args:
        document: the file; of its references the one that the record names.
        example: the record, which :func:`applies` to it.
        sets: X_I and W of the config, lower and upper end in each dimension.
        safe: what the loop must stay in.

    Returns:
        Nothing, or in one line what could not be proved.
    """
    r, step, states, disturbances = (example[key] for key in ("reference", "step", "states", "disturbances"))
    step, fraction = int(step), float(example["fraction"])
    tubes, last = document.tubes, document.horizon
    try:
        first = states[0]
        if not ((tubes["start_lower"][r] <= first) & (first <= tubes["start_upper"][r])).all():
            raise Unproved("it does not start in X_I")
        n = len(tubes["disturbance_lower"])
        disturbances, late = disturbances[:, :n], disturbances[:, n:]
        inside = (tubes["disturbance_lower"] <= disturbances) & (disturbances <= tubes["disturbance_upper"])
        if not inside.all():
            raise Unproved("its disturbances are not in W")
        lag = None if document.ode is None else document.ode.lag
        if lag is not None and not all(
            a <= s <= b for row in late for s, (a, b) in zip(row, (lag.delay, lag.jitter), strict=True)
        ):
            raise Unproved("its delays and jitters are not within their bounds")
        if not 0 <= step <= last:
            raise Unproved(f"its step {step} is none of the horizon {last}")
        if not (fraction == 0 or (0 < fraction < 1 and step < last and document.between != SAMPLES)):
            raise Unproved(f"its time, {fraction:.6g} of step {step} over, is none that the claim speaks of")
        with ctx.workprec(BITS):
            programs = [document.programs[i] for i in document.step_program]
            x0, windows = _moved(first, sets[0]), document.windows(r)
            if document.ode is not None:
                w = [_moved(row, sets[1]) for row in disturbances]
                return _broken_by_solution(document, (x0, w, windows, step, fraction), safe, late)
            w = [_moved(row, sets[1]) for row in disturbances[: step + (fraction > 0)]]
            x = replay(programs, x0, w, windows)
            now = on_line(x[step], x[step + 1], ball(fraction)) if fraction else x[step]
            if _violates(now, document.position, safe, at_end=step == last):
                return ""
            raise Unproved(f"its replay violates nothing for certain at step {step + fraction:.10g}")
    except (Unproved, ArithmeticError) as e:
        return str(e)


def _broken_by_solution(
    document: Document, given: tuple[Point, list[Point], np.ndarray, int, float], safe: SafeSet,
    late: np.ndarray,
) -> str:  # fmt: skip
    """Why a solution of the ODE breaks nothing for certain at a time, or nothing if it does.

    Args:
        document: the file.
        given: start, signal, windows, period and fraction of it, see :func:`~sagemp_cli.checker.solution.followed`.
        safe: what the loop must stay in.
        late: of a control that lags, seconds of delay and jitter beside the signal.
    """
    assert document.ode is not None
    step, fraction = given[3:]
    time = ball(step) + ball(fraction)  # exact
    asked = [one for one in document.requirements if ball(one.first) <= time and time <= ball(one.last)]
    why = ""
    for parts in PARTS:
        try:
            now = followed(document.ode, document.programs[0], *given, parts=parts, late=late)
        except Unproved as e:
            why = str(e)
            continue
        at_end = step == document.horizon
        if any(one.broken_at(now) for one in asked) or _violates(now, document.position, safe, at_end=at_end):
            return ""
        why = f"its replay violates nothing for certain at step {step + fraction:.10g}"
    return why


def _exact(values: Sequence[Any]) -> Point:
    return [v if isinstance(v, arb) else balls([v])[0] for v in values]


def _moved(point: np.ndarray, box: Ends) -> Point:
    """The nearest point of a box."""
    return [x.max(low).min(high) for x, (low, high) in zip(balls(point), box, strict=True)]


def _violates(x: Point, position: Sequence[int], safe: SafeSet, *, at_end: bool) -> bool:
    p = [x[i] for i in position]
    if any(c < a or c > b for c, a, b in zip(p, *safe.workspace, strict=True)) if safe.workspace else False:
        return True
    if any(c < a or c > b for c, a, b in zip(x, *safe.goal, strict=True)) if safe.goal and at_end else False:
        return True
    return any(_hits(p, o[1:]) for o in safe.obstacles)


def _hits(p: Point, shape: tuple[str, list[float], Any]) -> bool:
    kind, first, second = shape
    if kind == "block":
        return all(c >= a and c <= b for c, a, b in zip(p, first, second, strict=True))
    total = sum(((c - arb(a)) ** 2 for c, a in zip(p, first, strict=True)), start=arb(0))
    return bool(total <= arb(second) ** 2)


def applies(example: Mapping[str, Any], document: Document) -> bool:
    """Whether a record has the fields and shapes of a counterexample to one of the references."""
    tubes = document.tubes
    _, rows, n = tubes["tube_lower"].shape
    late = document.ode is not None and document.ode.lag is not None
    states, w, reference = (example.get(key) for key in ("states", "disturbances", "reference"))
    return bool(
        isinstance(states, np.ndarray)
        and isinstance(w, np.ndarray)
        and states.shape == (rows, n)
        and w.ndim == 2
        and w.shape[1] == len(tubes["disturbance_lower"]) + (2 if late else 0)
        and (w.shape[0] == rows - 1 or document.ode is not None)
        and isinstance(reference, int | np.integer)
        and 0 <= reference < len(tubes["verdict"])
        and isinstance(example.get("step"), int | np.integer)
        and isinstance(example.get("fraction"), float | np.floating)
    )
