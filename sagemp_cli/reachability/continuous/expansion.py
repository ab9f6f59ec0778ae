"""One period of a sampled loop as a step program: Taylor polynomials of the flow, their remainders a disturbance.

With the control u held, h the length of one of S equal parts of the period and ``a_j`` and ``b_j`` means of w over part
j, weighted towards its beginning and its end, ::

    x_{j+1} = x_j + h c_1 + h^2 c_2 + ... + h^p c_p + h/2 (b_j - a_j) + r_j

where ``c_1 = f(x_j, u) + a_j, c_2, ...`` are the Taylor coefficients of ``z' = f(z, u) + a_j`` from x_j on. Bounds of
``r_j`` are found in :mod:`~sagemp_cli.reachability.continuous.enclosure`; ``docs/continuous_time.md`` has the proof.
The step's disturbance is ``(a_1, b_1, r_1, ..., a_S, b_S, r_S)``; its output ``control`` is u and then
``x_1, ..., x_{S-1}``.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

from sagemp_cli.reachability.continuous.sampled import SampledLoop
from sagemp_cli.reachability.continuous.series import Series, state_coefficients
from sagemp_cli.reachability.continuous.writing import Writer
from sagemp_cli.reachability.flow import Division
from sagemp_cli.reachability.program.program import Program


@dataclass(frozen=True, eq=False)
class Expansion:
    """Programs that a proof in continuous time needs.

    Attributes:
        step: one period.
        rate: f, see :class:`~sagemp_cli.reachability.continuous.sampled.SampledLoop`.
        coefficients: of the state, the control as numbers and a constant w as disturbance; its output ``control`` is
            ``c_2`` and, of an order above 1, ``c_{p+1}``.
        tangent: of the state and, as numbers, the control and a direction v; its output ``control`` is ``Df v``.
        division: how the period is cut.
        length: of a part, h; exact.
    """

    step: Program
    rate: Program
    coefficients: Program
    tangent: Program
    division: Division
    length: float


@functools.lru_cache(maxsize=32)
def _coefficients(rate: Program, order: int) -> Program:
    n, m = rate.states, rate.numbers
    out = Writer(n, n, m)
    c = state_coefficients(out, rate, out.state, out.numbers, out.disturbance, order + 1)
    zeros = out.constant([0.0] * n)
    wanted = [zeros if c[q] is None else c[q] for q in ((2, order + 1) if order > 1 else (2,))]
    return out.finished(next=out.state, control=out.join(*(slot for slot in wanted if slot is not None)))


@functools.lru_cache(maxsize=32)
def _tangent(rate: Program) -> Program:
    n, m = rate.states, rate.numbers
    out = Writer(n, n, m + n)
    assert out.numbers is not None
    u = out.pick(out.numbers, 0, m) if m else None
    series = Series(out, rate, [out.state, out.pick(out.numbers, m, n)], u)
    series.next_order()
    slope = series.next_order()
    return out.finished(next=out.state, control=out.constant([0.0] * n) if slope is None else slope)


def expansion(loop: SampledLoop, division: Division) -> Expansion:
    """The programs of a loop."""
    n, s, h = loop.state_dim, division.substeps, loop.period / division.substeps
    out = Writer(n, 3 * n * s, loop.control.numbers)
    u = None
    inputs = {"state": out.state} | ({} if out.numbers is None else {"numbers": out.numbers})
    if loop.controls:
        u = out.embedded(loop.control, inputs).control
    x, between = out.state, []
    for j in range(s):
        a, b, r = (out.pick(out.disturbance, 3 * n * j + n * i, n) for i in range(3))
        c = state_coefficients(out, loop.rate, x, u, a, division.order)
        total: int | None = None
        for coefficient in c[:0:-1]:  # Horner's rule
            total = None if total is None else out.scaled(total, h)
            total = (
                total if coefficient is None else coefficient if total is None else out.of("add", coefficient, total)
            )
        turned = out.of("add", out.scaled(out.of("sub", b, a), h / 2), r)
        assert total is not None  # c_1 holds a
        x = out.of("add", x, out.of("add", out.scaled(total, h), turned))
        between.append(x)
    watched = [*([] if u is None else [u]), *between[:-1]]
    step = out.finished(next=x, control=out.join(*watched) if watched else None)
    return Expansion(step, loop.rate, _coefficients(loop.rate, division.order), _tangent(loop.rate), division, h)
