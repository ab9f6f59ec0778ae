"""Counterexamples: a stored rollout replayed in ball arithmetic, so that the violation is proved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sagemp_cli.checker.balls import Unproved, arb, balls, ctx
from sagemp_cli.checker.cell import Loop, Policy
from sagemp_cli.checker.form import Form, Step, array_of
from sagemp_cli.checker.scene import SafeSet
from sagemp_cli.dynamics.base import Dynamics

_BITS = 512  # a rollout has no other errors than rounding, which the loop may amplify


def prove_violation(
    example: Mapping[str, Any],
    tubes: Mapping[str, Any],
    start: Sequence[tuple[arb, arb]],
    disturbance: Sequence[tuple[arb, arb]],
    *,
    dynamics: Dynamics,
    policy: Policy,
    safe: SafeSet,
) -> str:
    """Prove that a rollout from X_I under disturbances in W leaves the safe set or misses the goal.

    The start and the disturbances are taken from the record as exact numbers, nothing else is. The boxes stored beside
    the tubes may be larger than X_I and W: from there everything is moved into the nearest point of those.

    Args:
        example: the record.
        tubes: references and the stored boxes.
        start, disturbance: X_I and W of the config, lower and upper end in each dimension.
        dynamics, policy, safe: the loop and what it must not do.

    Returns:
        Nothing, or in one line what could not be proved.
    """
    r, step, states, disturbances = (example[key] for key in ("reference", "step", "states", "disturbances"))
    try:
        reference = tubes["references"][r]
        first, last = states[0], len(reference) - 1
        if not ((tubes["start_lower"][r] <= first) & (first <= tubes["start_upper"][r])).all():
            raise Unproved("it does not start in X_I")
        inside = (tubes["disturbance_lower"] <= disturbances) & (disturbances <= tubes["disturbance_upper"])
        if disturbances.shape != (last, len(first)) or not inside.all() or not 0 <= step <= last:
            raise Unproved("its disturbances are not in W, or its step is not one of the horizon")
        with ctx.workprec(_BITS):
            loop, x = Loop(dynamics, policy, reference), _moved(first, start)
            for k in range(int(step)):
                w = _moved(disturbances[k], disturbance)
                now = Step(None, w, w)
                form = Form(now, array_of([now.constant(c) for c in x]))
                after = dynamics.step(form, loop.control(now, k, form), now.disturbance)
                x = [s.row[0, 0] for s in after.values]
            return "" if _violates(x, dynamics, safe, at_end=int(step) == last) else "the replay violates nothing"
    except (Unproved, ArithmeticError) as e:
        return str(e)


def _moved(point: np.ndarray, box: Sequence[tuple[arb, arb]]) -> list[arb]:
    """The nearest point of a box."""
    return [x.max(low).min(high) for x, (low, high) in zip(balls(point), box, strict=True)]


def _violates(x: list[arb], dynamics: Dynamics, safe: SafeSet, *, at_end: bool) -> bool:
    p = [x[i] for i in dynamics.position]
    outside = any(c < a or c > b for c, a, b in zip(p, *safe.workspace, strict=True))
    missed = at_end and any(c < a or c > b for c, a, b in zip(x, *safe.goal, strict=True))
    return outside or missed or any(_hits(p, o[1:]) for o in safe.obstacles)


def _hits(p: list[arb], shape: tuple[str, list[float], Any]) -> bool:
    kind, first, second = shape
    if kind == "block":
        return all(c >= a and c <= b for c, a, b in zip(p, first, second, strict=True))
    total = sum(((c - arb(a)) ** 2 for c, a in zip(p, first, strict=True)), start=arb(0))
    return bool(total <= arb(second) ** 2)


def applies(example: Mapping[str, Any], tubes: Mapping[str, Any]) -> bool:
    """Whether a record has the fields and shapes of a counterexample to one of the references."""
    count, rows, n = tubes["references"].shape
    states, w, reference = (example.get(key) for key in ("states", "disturbances", "reference"))
    return (
        isinstance(states, np.ndarray)
        and isinstance(w, np.ndarray)
        and states.shape == (rows, n)
        and w.shape == (rows - 1, n)
        and isinstance(reference, int | np.integer)
        and 0 <= reference < count
        and isinstance(example.get("step"), int | np.integer)
    )
