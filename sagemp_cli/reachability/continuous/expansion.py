"""One period of a sampled loop as a step program: Taylor polynomials of the flow, their remainders a disturbance.

With the control u held, h the length of one of S equal parts of the period and ``a_j`` and ``b_j`` means of w over part
j, weighted towards its beginning and its end, ::

    x_{j+1} = x_j + h c_1 + h^2 c_2 + ... + h^p c_p + h/2 (b_j - a_j) + r_j

where ``c_1 = f(x_j, u) + a_j, c_2, ...`` are the Taylor coefficients of ``z' = f(z, u) + a_j`` from x_j on. Bounds of
``r_j`` are found in :mod:`~sagemp_cli.reachability.continuous.enclosure`; ``docs/continuous_time.md`` has the proof.
The step's disturbance is ``(a_1, b_1, r_1, ..., a_S, b_S, r_S)``; its output ``control`` is u and then
``x_2, ..., x_S``.

A control that lags is part of the state: ``(x, p)`` with p the control before. What was measured is
``x - j (f(x, p) + v) + e``, ``(j, v, e)`` the first of the disturbance. In the first L parts, which the delay reaches
into, ``a_j`` and ``b_j`` are larger by shares of ``g_j = f(x_j, p) - f(x_j, u)``, which come after the remainder of
their part; ``g_1, ..., g_L`` and ``p - u`` are watched as well.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

from sagemp_cli.reachability.continuous.lagging import has_jitter, lagged_parts
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
        change: of the state and, as numbers, the control, a change d of it and a direction v; its output ``control`` is
            ``D_x (D_u f d) v``. None if no control lags.
        lagged: parts of a period that the delay may reach into, L.
        jitter: whether the control is of a state that is not that of the instant.
        division: how the period is cut.
        length: of a part, h; exact.
    """

    step: Program
    rate: Program
    coefficients: Program
    tangent: Program
    change: Program | None
    lagged: int
    jitter: bool
    division: Division
    length: float

    @property
    def lags(self) -> bool:
        """Whether the control before is part of the state."""
        return self.lagged > 0 or self.jitter


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


@functools.lru_cache(maxsize=32)
def _change(rate: Program) -> Program:
    n, m = rate.states, rate.numbers
    joint = Writer(n + m, 1)  # f of state and control as one
    given = {"state": joint.pick(joint.state, 0, n), "numbers": joint.pick(joint.state, n, m)}
    whole = joint.finished(next=joint.state, control=joint.embedded(rate, given).next)
    turned = Writer(n + 2 * m, 1)
    x, u, d = (turned.pick(turned.state, *part) for part in ((0, n), (n, m), (n + m, m)))
    slope = _second(turned, whole, turned.join(x, u), turned.join(turned.constant([0.0] * n), d))
    by_control = turned.finished(next=turned.state, control=slope)
    out = Writer(n, n, 2 * m + n)
    assert out.numbers is not None
    numbers, v = out.pick(out.numbers, 0, 2 * m), out.pick(out.numbers, 2 * m, n)
    state, along = out.join(out.state, numbers), out.join(v, out.constant([0.0] * 2 * m))
    return out.finished(next=out.state, control=_second(out, by_control, state, along))


def _second(out: Writer, program: Program, state: int, along: int) -> int:
    """The slope of a program's output ``control`` along a direction."""
    assert program.outputs.control is not None
    series = Series(out, program, [state, along], None, program.outputs.control)
    series.next_order()
    slope = series.next_order()
    size = program.instructions[program.outputs.control].size
    return out.constant([0.0] * size) if slope is None else slope


def expansion(loop: SampledLoop, division: Division) -> Expansion:
    """The programs of a loop; the last ones are kept, as a proof comes back to them."""
    lagged, jitter = lagged_parts(loop.lag, loop.period, division), has_jitter(loop.lag)
    return _expansion(loop.control, loop.rate, loop.period, division, lagged, jitter)


@functools.lru_cache(maxsize=4)
def _expansion(
    control: Program, rate: Program, period: float, division: Division, lagged: int, jitter: bool
) -> Expansion:
    n, m, s, h = rate.states, rate.numbers, division.substeps, period / division.substeps
    lags = lagged > 0 or jitter
    before = 1 + 2 * n if jitter else 0
    out = Writer(n + m if lags else n, before + 3 * n * s + 2 * lagged, control.numbers)
    taken = 0

    def disturbed(count: int) -> int:
        nonlocal taken
        taken += count
        return out.pick(out.disturbance, taken - count, count)

    x, held = (out.pick(out.state, 0, n), out.pick(out.state, n, m)) if lags else (out.state, None)
    measured = x
    if jitter:
        older, w, rest = disturbed(1), disturbed(n), disturbed(n)
        assert held is not None
        back = out.of("mul", older, out.of("add", _rate(out, rate, x, held), w))
        measured = out.of("add", out.of("sub", x, back), rest)
    u = None
    inputs = {"state": measured} | ({} if out.numbers is None else {"numbers": out.numbers})
    if m:
        u = out.embedded(control, inputs).control
    between, jumps = [], []
    for j in range(s):
        a, b, r = (disturbed(n) for _ in range(3))
        if j < lagged:
            assert held is not None and u is not None
            first, last = disturbed(1), disturbed(1)
            jumps.append(out.of("sub", _rate(out, rate, x, held), _rate(out, rate, x, u)))
            a, b = (out.of("add", w, out.of("mul", share, jumps[-1])) for w, share in ((a, first), (b, last)))
        c = state_coefficients(out, rate, x, u, a, division.order)
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
    watched = [*([] if u is None else [u]), *between[:-1], *jumps]
    if lagged:
        assert held is not None and u is not None
        watched.append(out.of("sub", held, u))
    after = out.join(x, u) if lags and u is not None else x
    step = out.finished(next=after, control=out.join(*watched) if watched else None)
    return Expansion(
        step,
        rate,
        _coefficients(rate, division.order),
        _tangent(rate),
        _change(rate) if lagged else None,
        lagged,
        jitter,
        division,
        h,
    )


def _rate(out: Writer, rate: Program, x: int, u: int) -> int:
    """f, as a value."""
    return out.embedded(rate, {"state": x, "numbers": u}).next
