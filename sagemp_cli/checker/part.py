"""What a file says of the flow within a part of a period: that it holds, by intervals.

Of a part of length h that begins in a box B, with controls in U, W a box of rates and ``r_W`` its radius
(``docs/continuous_time.md`` derives all of it):

- ``Y = B + [0, h] (f(X, U) + W)`` lies in X, so that no solution leaves Y;
- ``e >= A (3/4 h^2 r_W + h e)`` for ``A >= |Df|`` on Y and U bounds how far a solution is from that under a mean of w,
  but for what the integrals of both differ by; at the end of the part ``g = D 3/4 h^2 r_W + h A e`` does, with D the
  width of the bounds of Df;
- ``h^{p+1} c_{p+1}(Y, U, W) + [-g, g]`` lies in R, the disturbance that stands for what the polynomial leaves out;
- ``h^2 |c_2(Y, U, W)|`` is at most the stored curve.
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
    """

    inner_lower: np.ndarray
    inner_upper: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    remainder_lower: np.ndarray
    remainder_upper: np.ndarray
    curve: np.ndarray
    drift: np.ndarray


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

    def prove(self, claim: FlowClaim, place: tuple[int, int], begin: Column, control: Column) -> Column:
        """Prove what is claimed of part j of period k, which begins in a box, under controls in another.

        Returns:
            Y, which no solution leaves within the part.

        Raises:
            Unproved: it does not follow.
        """
        n, h = len(begin), ball(self._flow.length)
        inside = self._image(claim.lower[place], claim.upper[place], begin, control, h)
        (found,) = self._coefficients.of({"state": [inside], "disturbance": [self._w], "numbers": [control]})
        second, last = found[:n], found[-n:]
        end = self._drift_at_the_end(balls(claim.drift[place]), self._slopes(inside, control), h)
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

    def _image(self, lower: np.ndarray, upper: np.ndarray, begin: Column, control: Column, h: arb) -> Column:
        """Y, if it lies in X."""
        stay = list(zip(balls(lower), balls(upper), strict=True))
        if not all(a <= b for a, b in stay):
            raise Unproved("the box that the flow is said to stay in is empty")
        (rates,) = self._rate.of({"state": [stay], "numbers": [control]})
        inside = [
            (a + h * (low + least).min(arb(0)), b + h * (high + most).max(arb(0)))
            for (a, b), (low, high), (least, most) in zip(begin, rates, self._w, strict=True)
        ]
        for i, ((a, b), (low, high)) in enumerate(zip(inside, stay, strict=True)):
            if not (low <= a and b <= high):
                raise Unproved(
                    f"the flow of state {i} is only proved to stay in [{float(a):.9g}, {float(b):.9g}], the file says "
                    f"[{float(low):.9g}, {float(high):.9g}]"
                )
        return inside

    def _slopes(self, inside: Column, control: Column) -> list[Column]:
        """Bounds of Df, by rows."""
        n = len(inside)
        directions = [control + [ONE if i == j else NOTHING for i in range(n)] for j in range(n)]
        columns = self._slope.of({"state": [inside], "numbers": directions})
        columns = columns if len(columns) == n else columns * n
        return [[column[i] for column in columns] for i in range(n)]

    def _drift_at_the_end(self, drift: Sequence[arb], slopes: Sequence[Column], h: arb) -> list[arb]:
        """g, if e is what it is said to be: a bound of a size, for below 0 the inequality may hold of anything."""
        if not all(e >= 0 for e in drift):
            raise Unproved("a drift is below 0, or no number")
        swung = [3 * h * h / 4 * r for r in self._radius]
        end = []
        for i, row in enumerate(slopes):
            size = [_size(a) for a in row]
            carried = _sum(a * h * e for a, e in zip(size, drift, strict=True))
            if not _sum(a * s for a, s in zip(size, swung, strict=True)) + carried <= drift[i]:
                raise Unproved(f"state {i} may drift farther than the file says, {float(drift[i]):.9g}")
            end.append(_sum((b - a) * s for (a, b), s in zip(row, swung, strict=True)) + carried)
        return end


def _sum(terms: Iterable[arb]) -> arb:
    return sum(terms, start=arb(0))


def _size(a: Interval) -> arb:
    return arb(0) if a is NOTHING else (-a[0]).max(a[1])
