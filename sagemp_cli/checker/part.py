"""What a file says of the flow within a part of a period: that it holds, by intervals.

Of a part of length h that begins in a box B, with controls in U, W a box of rates and ``r_W`` its radius
(``docs/continuous_time.md`` derives all of it):

- ``Y = B + [0, h] (f(X, U) + W)`` lies in X, so that no solution leaves Y;
- ``e >= A (3/4 h^2 r_W + h e)`` for ``A >= |Df|`` on Y and U bounds how far a solution is from that under a mean of w,
  but for what the integrals of both differ by; at the end of the part ``g = D 3/4 h^2 r_W + h A e`` does, with D the
  width of the bounds of Df;
- ``h^{p+1} c_{p+1}(Y, U, W) + [-g, g]`` lies in R, the disturbance that stands for what the polynomial leaves out;
- ``h^2 |c_2(Y, U, W)|`` is at most the stored curve.

Where the control of the period before may be in force at first (:class:`Before`), what it moves the state by is in all
of these bounds.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from sagemp_cli.checker.balls import arb, ball, balls
from sagemp_cli.checker.intervals import NOTHING, Bounds, Column, Interval, point
from sagemp_cli.checker.ode import Flow
from sagemp_cli.checker.unproved import Unproved

ONE = point(arb(1))


@dataclass(frozen=True)
class FlowClaim:
    """What is claimed of the parts of all periods of a cell; arrays ``(K, S, n)``.

    Attributes:
        inner_lower, inner_upper: the states at the beginning of parts 2 to S, ``(K, S-1, n)``.
        lower, upper: X.
        remainder_lower, remainder_upper: R.
        curve, drift: the bounds of that name.
        jump: of a control that lags, bounds of what it changes the rate by at the beginning of each part; else 0.
        measured_lower, measured_upper: what is left out of the state that it is of, ``(K, n)``; else 0.
    """

    inner_lower: np.ndarray
    inner_upper: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    remainder_lower: np.ndarray
    remainder_upper: np.ndarray
    curve: np.ndarray
    drift: np.ndarray
    jump: np.ndarray
    measured_lower: np.ndarray
    measured_upper: np.ndarray


@dataclass(frozen=True)
class Before:
    """What is known of the control of the period before, which is in force for a share of a part at first.

    Attributes:
        control: its bounds.
        jump: bounds of what the rate is more under it, where the part begins.
        less: bounds of what it is more itself.
        share: bounds of the share.
        weight: the most that it may have in a mean of the part.
    """

    control: Column
    jump: Column
    less: Column
    share: tuple[arb, arb]
    weight: arb


class PartProver:
    """Proves claims about parts of a flow.

    Args:
        flow: its programs.
        lower, upper: W.
    """

    def __init__(self, flow: Flow, lower: np.ndarray, upper: np.ndarray) -> None:
        self._flow = flow
        self._w: Column = list(zip(balls(lower), balls(upper), strict=True))
        self._radius = [(b - a) / 2 for a, b in self._w]
        self._rate = Bounds(flow.rate, flow.rate.next)
        self._coefficients = Bounds(flow.coefficients, flow.coefficients.control)
        self._slope = Bounds(flow.slope, flow.slope.control)
        self._change = None if flow.change is None else Bounds(flow.change, flow.change.control)

    def prove(
        self, claim: FlowClaim, place: tuple[int, int], begin: Column, control: Column, before: Before | None = None
    ) -> Column:  # fmt: skip
        """Prove what is claimed of part j of period k, which begins in a box, under controls in another.

        Returns:
            Y, which no solution leaves within the part.

        Raises:
            Unproved: it does not follow.
        """
        n, h = len(begin), ball(self._flow.length)
        jump = balls(claim.jump[place])
        w, swung, pushed = self._w, [3 * h * h / 4 * r for r in self._radius], [arb(0)] * n
        if before is not None:
            for i, ((a, b), most) in enumerate(zip(before.jump, jump, strict=True)):
                if not (-most <= a and b <= most):
                    raise Unproved(f"a late control changes the rate of state {i} more than by {float(most):.9g}")
            reach = [before.weight * most for most in jump]
            w = [(a - r, b + r) for (a, b), r in zip(self._w, reach, strict=True)]
        elif any(most != 0 for most in jump):
            raise Unproved("a control is said to change that is not late")
        stay = list(zip(balls(claim.lower[place]), balls(claim.upper[place]), strict=True))
        inside = self._image(stay, begin, control, w, h, before)
        if before is not None:
            least, most = before.share
            swing = (arb(1) / 11).min(most / 2).min((1 - least) ** 2) * h * h
            swung = [s + swing * size for s, size in zip(swung, jump, strict=True)]
            pushed = self._pushed(inside, before, most * h)
        (found,) = self._coefficients.of({"state": [inside], "disturbance": [w], "numbers": [control]})
        second, last = found[:n], found[-n:]
        end = self._drift_at_the_end(balls(claim.drift[place]), self._slopes(inside, control), swung, pushed, h)
        power = h ** (self._flow.order + 1)
        low, high = balls(claim.remainder_lower[place]), balls(claim.remainder_upper[place])
        for i, (a, b) in enumerate(last):
            if not (low[i] <= a * power - end[i] and b * power + end[i] <= high[i]):
                found_low, found_high = float(a * power - end[i]), float(b * power + end[i])
                raise Unproved(
                    f"the remainder of state {i} is only proved to lie in [{found_low:.9g}, {found_high:.9g}], the "
                    f"file says [{float(low[i]):.9g}, {float(high[i]):.9g}]"
                )
        for i, ((a, b), curve) in enumerate(zip(second, balls(claim.curve[place]), strict=True)):
            if not (-curve <= a * h * h and b * h * h <= curve):
                raise Unproved(f"the path of state {i} may bend more than the file says, {float(curve):.9g}")
        return inside

    def measured(self, claim: FlowClaim, k: int, since: int, control: Column) -> None:
        """Prove what is left out of the state that is measured at the end of period k - 1, under the control of then:
        of the first state, which is measured at once, nothing.

        Raises:
            Unproved: it does not follow.
        """
        lag = self._flow.lag
        assert lag is not None
        if not k:
            if not ((claim.measured_lower[0] <= 0) & (claim.measured_upper[0] >= 0)).all():
                raise Unproved("of the first measured state, which is that of its instant, something is left out")
            return
        n = claim.lower.shape[2]
        sides = claim.lower[k - 1, since:].min(axis=0), claim.upper[k - 1, since:].max(axis=0)
        stay = list(zip(*map(balls, sides), strict=True))
        (found,) = self._coefficients.of({"state": [stay], "disturbance": [self._w], "numbers": [control]})
        squares = [ball(j) ** 2 for j in lag.jitter]
        low, high = balls(claim.measured_lower[k]), balls(claim.measured_upper[k])
        for i, (a, b) in enumerate(found[:n]):
            if not all(low[i] <= c * s and c * s <= high[i] for c in (a, b) for s in squares):
                raise Unproved(f"what is left out of the measured state {i} may be more than the file says")

    def _image(
        self, stay: Column, begin: Column, control: Column, w: Column, h: arb, before: Before | None
    ) -> Column:  # fmt: skip
        """Y, if it lies in X."""
        if not all(a <= b for a, b in stay):
            raise Unproved("the box that the flow is said to stay in is empty")
        rates = self._rates(stay, control, w)
        if before is not None:  # solutions, and those of constant disturbances
            other = self._rates(stay, before.control, self._w)
            rates = [(a.min(c), b.max(d)) for (a, b), (c, d) in zip(rates, other, strict=True)]
        inside = [
            (a + h * low.min(arb(0)), b + h * high.max(arb(0)))
            for (a, b), (low, high) in zip(begin, rates, strict=True)
        ]
        for i, ((a, b), (low, high)) in enumerate(zip(inside, stay, strict=True)):
            if not (low <= a and b <= high):
                raise Unproved(
                    f"the flow of state {i} is only proved to stay in [{float(a):.9g}, {float(b):.9g}], the file says "
                    f"[{float(low):.9g}, {float(high):.9g}]"
                )
        return inside

    def _rates(self, stay: Column, control: Column, w: Column) -> Column:
        """``f(X, U) + W``."""
        (rates,) = self._rate.of({"state": [stay], "numbers": [control]})
        return [(low + least, high + most) for (low, high), (least, most) in zip(rates, w, strict=True)]

    def _pushed(self, inside: Column, before: Before, seconds: arb) -> list[arb]:
        """``d^2 / 2 |D_x (f(x, p) - f(x, u)) x'|``, for the most seconds d that p is in force."""
        assert self._change is not None
        rates = self._rates(inside, before.control, self._w)
        given = before.control + before.less + rates
        (turned,) = self._change.of({"state": [inside], "numbers": [given]})
        return [seconds * seconds / 2 * _size(a) for a in turned]

    def _slopes(self, inside: Column, control: Column) -> list[Column]:
        """Bounds of Df, by rows."""
        n = len(inside)
        directions = [control + [ONE if i == j else NOTHING for i in range(n)] for j in range(n)]
        columns = self._slope.of({"state": [inside], "numbers": directions})
        columns = columns if len(columns) == n else columns * n
        return [[column[i] for column in columns] for i in range(n)]

    def _drift_at_the_end(
        self, drift: Sequence[arb], slopes: Sequence[Column], swung: Sequence[arb], pushed: Sequence[arb], h: arb
    ) -> list[arb]:
        """g, if e is what it is said to be: a bound of a size, for below 0 the inequality may hold of anything."""
        if not all(e >= 0 for e in drift):
            raise Unproved("a drift is below 0, or no number")
        end = []
        for i, row in enumerate(slopes):
            size = [_size(a) for a in row]
            carried = _sum(a * h * e for a, e in zip(size, drift, strict=True)) + pushed[i]
            if not _sum(a * s for a, s in zip(size, swung, strict=True)) + carried <= drift[i]:
                raise Unproved(f"state {i} may drift farther than the file says, {float(drift[i]):.9g}")
            end.append(_sum((b - a) * s for (a, b), s in zip(row, swung, strict=True)) + carried)
        return end


def _sum(terms: Iterable[arb]) -> arb:
    return sum(terms, start=arb(0))


def _size(a: Interval) -> arb:
    return arb(0) if a is NOTHING else (-a[0]).max(a[1])
