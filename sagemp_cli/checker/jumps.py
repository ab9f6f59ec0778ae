"""Functions that jump: those that round, and what is left when whole periods are taken off.

They give what :class:`~sagemp_cli.checker.functions.Function` gives, the excess over a line and the value of a ball.
Over an interval without a jump they are straight; over others all that is said is between which values they lie, and of
one that rounds by how much.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from sagemp_cli.checker.balls import Unproved, arb, ball

_HALF = ball(0.5)
Bounds = tuple[arb, arb]


@dataclass(frozen=True)
class Staircase:
    """A function that never falls.

    Attributes:
        least, most: bounds of its values at an exact number.
        below, above: bounds of ``f(x) - x``; None for a function that does not round.
    """

    least: Callable[[arb], arb]
    most: Callable[[arb], arb]
    below: Callable[[arb], arb] | None = None
    above: Callable[[arb], arb] | None = None

    def excess(self, slope: arb, lower: arb, upper: arb) -> Bounds:
        """Bounds of ``f(x) - slope x`` between the ends."""
        _require_finite(slope, lower, upper)
        low, high = self.least(lower.lower()), self.most(upper.upper())
        x = slope * lower, slope * upper
        least, most = low - x[0].max(x[1]), high - x[0].min(x[1])
        if low != high and self.below is not None and self.above is not None:
            rest = (1 - slope) * lower, (1 - slope) * upper
            least = least.max(self.below(upper) + rest[0].min(rest[1]))
            most = most.min(self.above(lower) + rest[0].max(rest[1]))
        return least, most

    def value(self, x: arb) -> arb:
        """``f`` of a ball."""
        return self.least(x.lower()).union(self.most(x.upper()))


@dataclass(frozen=True)
class Sawtooth:
    """``x - P n``, n the whole number of periods in ``x + shift``, rounded down or, with ``signed``, towards 0."""

    period: Callable[[], arb]
    shift: Callable[[], arb] = lambda: arb(0)
    signed: bool = False

    def excess(self, slope: arb, lower: arb, upper: arb) -> Bounds:
        """Bounds of ``f(x) - slope x`` between the ends."""
        _require_finite(slope, lower, upper)
        found = self._whole(lower, upper)
        if found is None:
            low, high = self._hull(lower, upper)
            x = slope * lower, slope * upper
            return low - x[0].max(x[1]), high - x[0].min(x[1])
        ends = [(1 - slope) * x - found * self.period() for x in (lower, upper)]
        return ends[0].min(ends[1]), ends[0].max(ends[1])

    def value(self, x: arb) -> arb:
        """``f`` of a ball."""
        found = self._whole(x, x)
        if found is None:
            low, high = self._hull(x, x)
            return low.union(high)
        return x - found * self.period()

    def straight(self, lower: arb, upper: arb) -> bool:
        """Whether it does not jump between the ends."""
        return self._whole(lower, upper) is not None

    def _whole(self, lower: arb, upper: arb) -> arb | None:
        """The number of periods, if it is the same between the ends."""
        ends = [((x + self.shift()) / self.period()) for x in (lower, upper)]
        low, high = (self._rounded(x) for x in (ends[0].lower(), ends[1].upper()))
        return low if low == high else None

    def _rounded(self, x: arb) -> arb:
        return x.ceil() if self.signed and x < 0 else x.floor()

    def _hull(self, lower: arb, upper: arb) -> Bounds:
        period, shift = self.period(), self.shift()
        if not self.signed:
            return -shift, period - shift
        return lower.min(arb(0)).max(-period), upper.max(arb(0)).min(period)


def _require_finite(*numbers: arb) -> None:
    if not all(n.is_finite() for n in numbers):
        raise Unproved("an interval is not finite")


def _towards_0(x: arb) -> arb:
    return x.ceil() if x < 0 else x.floor()


def _least_nearest(x: arb) -> arb:
    """The nearest whole number, of two the even one."""
    moved = x - _HALF
    found = moved.ceil()
    return found + 1 if moved == found and _is_odd(found) else found


def _most_nearest(x: arb) -> arb:
    moved = x + _HALF
    found = moved.floor()
    return found - 1 if moved == found and _is_odd(found) else found


def _is_odd(whole: arb) -> bool:
    return bool((whole / 2).floor() * 2 != whole)


def _sign(x: arb) -> arb:
    return arb(1) if x > 0 else arb(-1) if x < 0 else arb(0)


def _positive(x: arb) -> arb:
    return arb(1) if x > 0 else arb(0)


def _number(value: float) -> Callable[[arb], arb]:
    return lambda x: arb(value)


JUMPS: Mapping[str, Staircase | Sawtooth] = {
    "floor": Staircase(arb.floor, arb.floor, _number(-1), _number(0)),
    "ceil": Staircase(arb.ceil, arb.ceil, _number(0), _number(1)),
    "round": Staircase(_least_nearest, _most_nearest, _number(-0.5), _number(0.5)),
    "trunc": Staircase(
        _towards_0, _towards_0, lambda upper: arb(0 if upper <= 0 else -1), lambda lower: arb(0 if lower >= 0 else 1)
    ),
    "sign": Staircase(_sign, _sign),
    "positive": Staircase(_positive, _positive),
    "wrap": Sawtooth(lambda: 2 * arb.pi(), arb.pi),
}
"""Functions without parameters."""


def remainder(period: float) -> Sawtooth:
    """``x - m floor(x / m)``."""
    return Sawtooth(lambda: ball(period))


def fmod(period: float) -> Sawtooth:
    """``x - m trunc(x / m)``."""
    return Sawtooth(lambda: ball(period), signed=True)
