"""A loop in continuous time as programs: its period, and what bounds the flow within a part of one.

``x'(t) = f(x(t), u_k) + w(t)``, ``u_k = c_k(x(t_k))`` held over the period k. ``docs/continuous_time.md`` specifies the
program of a period to the order of its instructions and proves what is used here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from sagemp_cli.checker.program import Program
from sagemp_cli.checker.taylor import Expansion, Series, Value, require_smooth, solution
from sagemp_cli.checker.writing import Writer

MOST_SUBSTEPS, MOST_ORDER = 4096, 30


@dataclass(frozen=True)
class Flow:
    """Programs of a loop.

    Attributes:
        step: a period; its disturbance is ``a_1, b_1, r_1, ..., a_S, b_S, r_S``, its control ``u, x_2, ..., x_S``.
        rate: f of the state and, as its numbers, u.
        coefficients: of state, a and u: ``c_2`` and, of an order above 1, ``c_{p+1}``, as its control.
        slope: of state and, as numbers, u and a direction d: ``Df d``, as its control.
        substeps, order: S and p.
        length: of a part, h.
    """

    step: Program
    rate: Program
    coefficients: Program
    slope: Program
    substeps: int
    order: int
    length: float

    @property
    def controls(self) -> int:
        """Entries of u, m."""
        return self.rate.numbers


def flow_of(control: Program, rate: Program, *, period: float, substeps: int, order: int) -> Flow:
    """The programs of a loop.

    Args:
        control: c, its output ``control`` is u; there is none if the rate has no numbers.
        rate: f.
        period: seconds.
        substeps: equal parts of a period, a power of two.
        order: degree of the Taylor polynomials.

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
    step = _step(control, rate, substeps, order, length)
    return Flow(step, rate, _coefficients(rate, order), _slope(rate), substeps, order, length)


def _step(control: Program, rate: Program, substeps: int, order: int, length: float) -> Program:
    n = rate.states
    out = Writer(n, 3 * n * substeps, control.numbers)
    u = _embedded(out, control) if rate.numbers else None
    x, ends = out.state, []
    for j in range(substeps):
        a, b, r = (out.part(out.disturbance, (3 * j + i) * n, n) for i in range(3))
        way = _polynomial(out, solution(out, rate, x, u, a, order)[1:], length)
        rest = out.put("add", out.times(out.put("sub", b, a), length / 2), r)
        x = out.put("add", x, out.put("add", out.times(way, length), rest))
        ends.append(x)
    watched = [] if u is None else [u]
    watched += ends[:-1]
    outputs = {"next": x}
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


def _embedded(out: Writer, control: Program) -> int:
    """The control on the state at the beginning of the period."""
    places: list[int] = []
    inputs = {"state": out.state, "disturbance": out.disturbance, "numbers": out.numbers}
    for i in control.instructions:
        given = inputs.get(i.kind)
        places.append(given if given is not None else out.copy(i, [places[r] for r in i.reads]))
    return places[control.control]


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
