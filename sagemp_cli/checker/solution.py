"""One solution of an ODE under a disturbance that is constant on equal pieces of every period, followed in intervals.

There is one start and one signal, so a box around the solution is as narrow as the arithmetic and the remainder of a
Taylor polynomial of a high degree let it be; the loop widens it from period to period, and many digits are kept for
that. Where it becomes too wide, nothing is proved.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from sagemp_cli.checker.balls import arb, ball, balls
from sagemp_cli.checker.intervals import Bounds, Column, add, mul, point, points
from sagemp_cli.checker.ode import Flow
from sagemp_cli.checker.points import Point, outputs_at
from sagemp_cli.checker.program import Program
from sagemp_cli.checker.taylor import solution
from sagemp_cli.checker.unproved import Unproved
from sagemp_cli.checker.writing import Writer

ORDER = 14
"""Degree of the polynomials."""
PARTS = (2, 16)
"""Parts of a period at least: a few, which mostly do, and then as many as may help."""
MOST_PIECES = 1024
"""Of a period, on which the disturbance is constant."""
_ROUNDS = 20


def followed(
    ode: Flow, control: Program, start: Point, signal: Sequence[Point], windows: np.ndarray, step: int, fraction: float,
    parts: int, late: np.ndarray | None = None,
) -> Point:  # fmt: skip
    """A box around the state after some periods and a fraction of the next.

    Args:
        ode: the loop's flow.
        control: its control.
        start: x(0).
        signal: w on each of equally many pieces of every period, a power of two; all periods of the windows.
        windows: numbers of the control, ``(K, g)``.
        step: whole periods that pass, at most K.
        fraction: of the period after them, in [0, 1).
        parts: that a period is followed in at least, a power of two.
        late: of a control that lags, seconds of its delay and of its measurement's jitter in the rows of the signal, of
            which the first of every period counts; those of the first instant are left aside.

    Raises:
        Unproved: no box was found that the solution stays in, or it is too wide; or a signal that does not fit.
    """
    pieces, rest = divmod(len(signal), len(windows))
    if rest or pieces < 1 or pieces > MOST_PIECES or pieces & (pieces - 1):
        raise Unproved(
            f"its signal has {len(signal)} pieces, in {len(windows)} periods; a power of two is needed in each"
        )
    parts = max(parts, pieces)
    try:
        follower = _Follower(ode, parts)
    except ValueError as e:
        raise Unproved(str(e)) from None
    seconds = None if late is None or ode.lag is None else late[::pieces]
    x, measured, held = list(start), list(start), None
    for k in range(step + (fraction > 0)):
        numbers: Column = []
        if ode.controls:
            inputs = {"state": measured, "disturbance": signal[k * pieces], "numbers": balls(windows[k])}
            numbers = [(u.lower(), u.upper()) for u in outputs_at(control, inputs)["control"]]
        box, own = [(v.lower(), v.upper()) for v in x], signal[k * pieces : (k + 1) * pieces]
        now, end = Fraction(0), follower.period * (Fraction(fraction) if k == step else 1)
        if seconds is not None:
            if held is not None:  # the control before, until this one comes
                now = min(Fraction(float(seconds[k, 0])), end)
                box = follower.through(box, held, own, Fraction(0), now)
            if k + 1 < min(len(windows), step + (fraction > 0)):  # what the next one is computed from
                then = follower.period - Fraction(float(seconds[k + 1, 1]))
                box, now = follower.through(box, numbers, own, now, then), then
                measured = _union(box)
        x = _union(follower.through(box, numbers, own, now, end))
        measured = x if seconds is None else measured
        held = numbers
        if not all(v.is_finite() for v in x):
            raise Unproved(f"its solution cannot be followed through period {k}: the box around it becomes too wide")
    return x


def _union(box: Column) -> Point:
    return [low.union(high) for low, high in box]


class _Follower:
    """Steps of at most ``length`` seconds, so many to a period."""

    def __init__(self, ode: Flow, parts: int) -> None:
        n = ode.rate.states
        out = Writer(n, n, ode.rate.numbers)
        c = solution(out, ode.rate, out.state, out.numbers, out.disturbance, ORDER + 1)
        zeros = out.constant([0.0] * n)
        made = out.finished(
            {"next": out.state, "control": out.join([zeros if v is None else v for v in c[1:]])}
        )  # fmt: skip
        self._n, self._rate = n, Bounds(ode.rate, ode.rate.next)
        self._coefficients = Bounds(made, made.control)
        self.period, self._parts = Fraction(ode.period), parts
        self.length = ball(ode.length) * ode.substeps / parts

    def through(self, box: Column, numbers: Column, signal: Sequence[Point], begin: Fraction, end: Fraction) -> Column:
        """A box around the state at a time of a period, from one at an earlier time, in seconds."""
        piece, length = self.period / len(signal), self.period / self._parts
        while begin < end:
            i = int(begin / piece)
            stop = min(end, (i + 1) * piece)
            count = math.ceil((stop - begin) / length)
            time = (stop - begin) / count
            for _ in range(count):
                box = self.after(box, numbers, points(signal[i]), arb(time.numerator) / time.denominator)
            begin = stop
        return box

    def after(self, box: Column, numbers: Column, w: Column, time: arb) -> Column:
        """A box around the state some time later, at most a step."""
        inside = self._stay(box, numbers, w)
        given = {"disturbance": [w], "numbers": [numbers]}
        (at,), (over,) = (self._coefficients.of({"state": [x], **given}) for x in (box, inside))
        total = over[-self._n :]  # of degree p + 1, over all that the solution may be at
        for q in range(ORDER - 1, -1, -1):
            own = at[q * self._n : (q + 1) * self._n]
            total = [add(c, mul(t, point(time))) for c, t in zip(own, total, strict=True)]
        return [add(x, mul(t, point(time))) for x, t in zip(box, total, strict=True)]

    def _stay(self, box: Column, numbers: Column, w: Column) -> Column:
        """A box that the solution stays in over a step: it holds what comes out of it."""
        trial = self._image(box, box, numbers, w)
        for _ in range(_ROUNDS):
            wider = [(a - (b - a) / 8, b + (b - a) / 8) for a, b in trial]
            found = self._image(box, wider, numbers, w)
            if all(a <= c and d <= b for (a, b), (c, d) in zip(wider, found, strict=True)):
                return found
            trial = [(a.min(c), b.max(d)) for (a, b), (c, d) in zip(trial, found, strict=True)]
        raise Unproved("no box was found that the solution stays in")

    def _image(self, box: Column, stay: Column, numbers: Column, w: Column) -> Column:
        (rates,) = self._rate.of({"state": [stay], "numbers": [numbers]})
        slopes = [add(r, v) for r, v in zip(rates, w, strict=True)]
        return [
            (a + self.length * low.min(arb(0)), b + self.length * high.max(arb(0)))
            for (a, b), (low, high) in zip(box, slopes, strict=True)
        ]
