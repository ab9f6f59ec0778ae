"""A loop in continuous time as programs: its period, and what bounds the flow within a part of one.

``x'(t) = f(x(t), u_k) + w(t)``, ``u_k = c_k(x(t_k))`` held over the period k. ``docs/continuous_time.md`` specifies the
program of a period to the order of its instructions and proves what is used here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sagemp_cli.checker.lag import Lag
from sagemp_cli.checker.program import Program
from sagemp_cli.checker.taylor import Expansion, Series, Value, require_smooth, solution
from sagemp_cli.checker.writing import Writer

MOST_SUBSTEPS, MOST_ORDER = 4096, 30

Sides = tuple[np.ndarray, np.ndarray]
"""Lower and upper bounds."""


@dataclass(frozen=True)
class Flow:
    """Programs of a loop.

    Attributes:
        step: a period; its disturbance is ``a_1, b_1, r_1, ..., a_S, b_S, r_S``, its control ``u, x_2, ..., x_S``. Of a
            control that lags the state is ``x, p``, with p the control before, the disturbance of more (see
            :func:`_step`), and ``f(x_j, p) - f(x_j, u)`` and ``p - u`` are part of its control.
        rate: f of the state and, as its numbers, u.
        coefficients: of state, a and u: ``c_2`` and, of an order above 1, ``c_{p+1}``, as its control.
        slope: of state and, as numbers, u and a direction d: ``Df d``, as its control.
        change: of state and, as numbers, u, a change d of it and a direction v: ``D_x (D_u f d) v``, as its control.
        lag: of the control; None if there is none.
        substeps, order: S and p.
        length: of a part, h.
    """

    step: Program
    rate: Program
    coefficients: Program
    slope: Program
    change: Program | None
    lag: Lag | None
    substeps: int
    order: int
    length: float

    @property
    def controls(self) -> int:
        """Entries of u, m."""
        return self.rate.numbers

    @property
    def period(self) -> float:
        """Seconds."""
        return self.length * self.substeps

    @property
    def lagged(self) -> int:
        """Parts of a period that the delay may reach into, L."""
        return 0 if self.lag is None else self.lag.parts(self.period, self.substeps)

    @property
    def jitters(self) -> bool:
        """Whether what is measured may be older than its instant."""
        return self.lag is not None and self.lag.jitter[1] > 0

    def given(self, w: Sides, rest: Sides, measured: Sides) -> tuple[np.ndarray, np.ndarray]:
        """Both sides of the disturbance of all periods of a cell, ``(K, d)``.

        Args:
            w: W, ``(n,)``.
            rest: of the remainders, ``(K, S, n)``.
            measured: of what is left out of the measured state, ``(K, n)``.
        """
        periods, lag, sides = len(rest[0]), self.lag, []
        there = (np.arange(periods) > 0)[:, None]
        for i in (0, 1):
            mean, columns = np.broadcast_to(w[i], (periods, len(w[i]))), list[np.ndarray]()
            if lag is not None and self.jitters:
                columns += [there * lag.jitter[i], mean, measured[i]]
            for j in range(self.substeps):
                columns += [mean, mean, rest[i][:, j]]
                if lag is not None and j < self.lagged:
                    columns += [there * share[i] for share in lag.means(j, self.period, self.substeps)]
            sides.append(np.concatenate(columns, axis=1))
        return sides[0], sides[1]


def flow_of(
    control: Program, rate: Program, *, period: float, substeps: int, order: int, lag: Lag | None = None
) -> Flow:  # fmt: skip
    """The programs of a loop.

    Args:
        control: c, its output ``control`` is u; there is none if the rate has no numbers.
        rate: f.
        period: seconds.
        substeps: equal parts of a period, a power of two.
        order: degree of the Taylor polynomials.
        lag: of the control.

    Raises:
        ValueError: a part that does not fit, is not smooth or too large.
    """
    require_smooth(rate)
    if control.reads_disturbance:
        raise ValueError("the control reads the disturbance, which nobody measures")
    if rate.control >= 0 or rate.deviation >= 0 or control.deviation >= 0:
        raise ValueError("the right-hand side of the ODE or the control has an output that neither has")
    if control.controls != rate.numbers or control.states != rate.states:
        raise ValueError(
            f"the control makes {control.controls} numbers of {control.states} states, the right-hand side of the ODE "
            f"takes {rate.numbers} and {rate.states}"
        )
    if not 1 <= substeps <= MOST_SUBSTEPS or substeps & (substeps - 1):
        raise ValueError(f"a period is cut into {substeps} parts; powers of two up to {MOST_SUBSTEPS} can be checked")
    if not 1 <= order <= MOST_ORDER:
        raise ValueError(f"the order is {order}; 1 to {MOST_ORDER} can be checked")
    length = period / substeps
    if not (length > 0 and period < math.inf and length / 2 * (2 * substeps) == period):
        raise ValueError(f"the period is {period} s")
    if lag is not None and not rate.numbers:
        raise ValueError("a control lags that there is not")
    step = _step(control, rate, substeps, order, length, lag)
    change = _change(rate) if lag is not None and lag.delay[1] > 0 else None
    return Flow(step, rate, _coefficients(rate, order), _slope(rate), change, lag, substeps, order, length)


def _step(control: Program, rate: Program, substeps: int, order: int, length: float, lag: Lag | None) -> Program:
    """A period. Of a control that lags with jitter the disturbance begins with ``j, v, e``, of a state that is measured
    as ``x - j (f(x, p) + v) + e``; of every part that the delay may reach into, both weights of the jump come last.
    """
    n, m = rate.states, rate.numbers
    lagged = 0 if lag is None else lag.parts(length * substeps, substeps)
    jitters = lag is not None and lag.jitter[1] > 0
    count = 3 * n * substeps + 2 * lagged + (1 + 2 * n if jitters else 0)
    out = Writer(n if lag is None else n + m, count, control.numbers)
    x, p = (out.state, None) if lag is None else (out.part(out.state, 0, n), out.part(out.state, n, m))
    taken = 0

    def given(width: int) -> int:
        nonlocal taken
        taken += width
        return out.part(out.disturbance, taken - width, width)

    measured = x
    if jitters:
        j, v, e = given(1), given(n), given(n)
        way = out.put("mul", j, out.put("add", _embedded(out, rate, x, p, rate.next), v))
        measured = out.put("add", out.put("sub", x, way), e)
    u = _embedded(out, control, measured, out.numbers, control.control) if m else None
    ends, jumps = [], []
    for part in range(substeps):
        a, b, r = (given(n) for _ in range(3))
        if part < lagged:
            early, late = given(1), given(1)
            jump = out.put("sub", *(_embedded(out, rate, x, value, rate.next) for value in (p, u)))
            a, b = out.put("add", a, out.put("mul", early, jump)), out.put("add", b, out.put("mul", late, jump))
            jumps.append(jump)
        way = _polynomial(out, solution(out, rate, x, u, a, order)[1:], length)
        rest = out.put("add", out.times(out.put("sub", b, a), length / 2), r)
        x = out.put("add", x, out.put("add", out.times(way, length), rest))
        ends.append(x)
    watched = [] if u is None else [u]
    watched += ends[:-1]
    if lagged and u is not None and p is not None:
        watched += [*jumps, out.put("sub", p, u)]
    outputs = {"next": x if lag is None or u is None else out.join([x, u])}
    if watched:
        outputs["control"] = out.join(watched)
    return out.finished(outputs)


def _polynomial(out: Writer, c: Series, length: float) -> int:
    """``c_1 + h (c_2 + h (c_3 + ...))``."""
    total: Value = None
    for coefficient in reversed(c):
        if total is not None:
            total = out.times(total, length)
        if coefficient is not None:
            total = coefficient if total is None else out.put("add", coefficient, total)
    assert total is not None  # c_1 holds a
    return total


def _embedded(out: Writer, program: Program, state: int, numbers: Value, output: int) -> int:
    """An output of the control or the rate, of a state and numbers."""
    places: list[int] = []
    inputs = {"state": state, "disturbance": out.disturbance, "numbers": numbers}
    for i in program.instructions:
        given = inputs.get(i.kind)
        places.append(given if given is not None else out.copy(i, [places[r] for r in i.reads]))
    return places[output]


def _coefficients(rate: Program, order: int) -> Program:
    n, m = rate.states, rate.numbers
    out = Writer(n, n, m)
    c = solution(out, rate, out.state, out.numbers, out.disturbance, order + 1)
    nothing = out.constant([0.0] * n)
    found = (c[q] for q in ((2,) if order == 1 else (2, order + 1)))
    wanted = [nothing if one is None else one for one in found]
    return out.finished({"next": out.state, "control": out.join(wanted)})


def _slope(rate: Program) -> Program:
    n, m = rate.states, rate.numbers
    out = Writer(n, n, m + n)
    given = out.numbers
    assert given is not None
    u = out.part(given, 0, m) if m else None
    along = Expansion(out, rate, [out.state, out.part(given, m, n)], u)
    along.order(0)
    slope = along.order(1)
    return out.finished({"next": out.state, "control": out.constant([0.0] * n) if slope is None else slope})


def _change(rate: Program) -> Program:
    """How the rate's slope by the control changes along a direction of the state."""
    n, m = rate.states, rate.numbers
    joint = Writer(n + m, 1)
    x, u = joint.part(joint.state, 0, n), joint.part(joint.state, n, m)
    whole = joint.finished({"next": joint.state, "control": _embedded(joint, rate, x, u, rate.next)})
    turned = Writer(n + 2 * m, 1)
    x, u, d = (turned.part(turned.state, first, size) for first, size in ((0, n), (n, m), (n + m, m)))
    along = turned.join([turned.constant([0.0] * n), d])
    by_control = turned.finished({"next": turned.state, "control": _along(turned, whole, turned.join([x, u]), along)})
    out = Writer(n, n, 2 * m + n)
    given = out.numbers
    assert given is not None
    state = out.join([out.state, out.part(given, 0, 2 * m)])
    along = out.join([out.part(given, 2 * m, n), out.constant([0.0] * (2 * m))])
    return out.finished({"next": out.state, "control": _along(out, by_control, state, along)})


def _along(out: Writer, program: Program, state: int, direction: int) -> int:
    """The slope of a program's output ``control``."""
    expansion = Expansion(out, program, [state, direction], None, program.control)
    expansion.order(0)
    slope = expansion.order(1)
    return out.constant([0.0] * program.controls) if slope is None else slope
