"""What a file says has to hold of the state at all times of an interval, and that it does.

A requirement is a function of the state, its margins, which must not be negative: all of them, or at each time one of
them at least. Of a margin g and a part of length h that begins in a box B and ends in a box E and does not leave Y::

    g(x(t)) >= the least of g over Y
    g(x(t)) >= max(a + t r, b - (h - t) s)
    g(x(t)) >= min(a, b) - h^2 / 4 |c_2|    where w cannot change

with a and b the least of g over B and E, ``[r, s]`` bounds of its rate of change ``Dg(x) (f(x, u) + w)`` over Y, and
c_2 its second Taylor coefficient along the solution. The second holds since g is the integral of its rate of change,
which needs g to be smooth on Y; any share of one line and the rest of the other bounds as well, and is least at an end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sagemp_cli.checker.balls import arb, ball, balls
from sagemp_cli.checker.clearance import smallest
from sagemp_cli.checker.intervals import Bounds, Column
from sagemp_cli.checker.ode import Flow
from sagemp_cli.checker.points import Point, outputs_at
from sagemp_cli.checker.program import Program
from sagemp_cli.checker.taylor import Expansion, solution
from sagemp_cli.checker.unproved import Unproved
from sagemp_cli.checker.writing import Writer

MOST_REQUIREMENTS = 1000


@dataclass(frozen=True)
class Required:
    """One requirement.

    Attributes:
        name: what the file calls it.
        margins: of the state; its output ``control``.
        every: whether all margins must hold, or at each time one of them at least.
        strict: whether a margin must be above 0, or 0 will do.
        first, last: of the interval, both included, in periods.
    """

    name: str
    margins: Program
    every: bool
    strict: bool
    first: float
    last: float

    def require_sense(self, states: int, periods: int) -> None:
        """Refuse what is no requirement of a loop.

        Raises:
            ValueError: saying why.
        """
        program, said = self.margins, f"requirement '{self.name[:40]}'"
        if program.states != states or program.controls < 1 or program.deviation >= 0 or program.numbers:
            raise ValueError(f"{said}: its margins are no function of {states} states")
        if program.reads_disturbance:
            raise ValueError(f"{said}: its margins read the disturbance")
        if not 0 <= self.first <= self.last <= periods:
            raise ValueError(f"{said} speaks of periods {self.first!r} to {self.last!r}, not within 0 to {periods}")

    def holds(self, margin: arb) -> bool:
        """Whether a margin is certainly large enough."""
        return bool(margin > 0) if self.strict else bool(margin >= 0)

    def least(self, margins: Sequence[arb]) -> arb:
        """Of lower bounds of all margins, that of the one that decides.

        Raises:
            Unproved: nothing is known of it.
        """
        known = [m for m in margins if m.is_finite()]
        if not known or (self.every and len(known) < len(margins)):
            raise Unproved("its margin has no bound")
        found = known[0]
        for m in known[1:]:
            found = found.min(m) if self.every else found.max(m)
        return found

    def broken_at(self, x: Point) -> bool:
        """Whether a state certainly breaks it."""
        inputs = {"state": x, "disturbance": [arb(0)] * self.margins.disturbances}
        broken = [m <= 0 if self.strict else m < 0 for m in outputs_at(self.margins, inputs)["control"]]
        return any(broken) if self.every else all(broken)


class MarginProver:
    """Bounds the margins of a requirement along a flow from below.

    Args:
        required: it.
        flow: the loop's programs.
        lower, upper: W.
    """

    def __init__(self, required: Required, flow: Flow, lower: np.ndarray, upper: np.ndarray) -> None:
        program = required.margins
        self.required, self._size, self._parts = required, program.controls, flow.substeps
        self._w: Column = list(zip(balls(lower), balls(upper), strict=True))
        self._constant, self._h = bool((lower == upper).all()), ball(flow.length)
        self._value = Bounds(program, program.control, smooth=False)
        self._smooth = Bounds(program, program.control)
        change = _change(program, flow)
        self._change = None if change is None else Bounds(change, change.control)

    def least(self, i: int, begin: Column, end: Column, inside: Column, control: Column) -> arb | None:
        """Of the part i, counted from the start, at the times of it that are asked for; None if none are.

        Args:
            i: part of all periods.
            begin, end: boxes around the state where the part begins and ends.
            inside: a box that it does not leave in between.
            control: of the controls.

        Raises:
            Unproved: nothing is known of it.
        """
        asked, first, last = self.required, self.required.first * self._parts, self.required.last * self._parts
        ends = [box for place, box in ((i, begin), (i + 1, end)) if first <= place <= last]
        found = [asked.least(self._at(box)) for box in ends]
        if first < i + 1 and i < last:
            found.append(asked.least(self._over(begin, end, inside, control)))
        return smallest(found) if found else None

    def _at(self, box: Column) -> list[arb]:
        (found,) = self._value.of({"state": [box]})
        return [low for low, _ in found]

    def _over(self, begin: Column, end: Column, inside: Column, control: Column) -> list[arb]:
        direct = self._at(inside)
        if self._change is None:
            return direct
        try:
            self._smooth.of({"state": [inside]})
            (change,) = self._change.of({"state": [inside], "disturbance": [self._w], "numbers": [control]})
            ends = self._at(begin), self._at(end)
        except Unproved:  # a pole of the rate of change, or an angle that may jump
            return direct
        found = []
        for i, (at, a, b) in enumerate(zip(direct, *ends, strict=True)):
            (slow, fast), (low, high) = change[i], change[self._size + i]
            best = _larger(at, self._between(a, b, slow, fast))
            if self._constant:
                best = _larger(best, a.min(b) - (-low).max(high) * self._h * self._h / 4)
            found.append(best)
        return found

    def _between(self, a: arb, b: arb, slow: arb, fast: arb) -> arb:
        """Of a share of the line from the beginning and the rest of that from the end, the lower end."""
        falls, rises = self._h * slow.min(arb(0)), self._h * fast.max(arb(0))
        share = (rises / (rises - falls)).mid()
        share = share.max(arb(0)).min(arb(1)) if share.is_finite() else arb(1) / 2  # any in [0, 1] will do
        rest = 1 - share
        return (share * a + rest * (b - rises)).min(share * (a + falls) + rest * b)


def _larger(a: arb, b: arb) -> arb:
    """Of two lower bounds the better one; one that is no number bounds nothing."""
    return a.max(b) if a.is_finite() and b.is_finite() else a if a.is_finite() else b


def _change(margins: Program, flow: Flow) -> Program | None:
    """Of state, a constant w and u: first and second Taylor coefficients of the margins along the solution; None if
    they have a kink."""
    rate = flow.rate
    out = Writer(rate.states, rate.states, rate.numbers)
    states = solution(out, rate, out.state, out.numbers, out.disturbance, 2)
    try:
        along = Expansion(out, margins, states, None, margins.control)
    except ValueError:
        return None
    along.order(0)
    zeros = out.constant([0.0] * margins.controls)
    found = [along.order(q) for q in (1, 2)]
    return out.finished({"next": out.state, "control": out.join([zeros if c is None else c for c in found])})
