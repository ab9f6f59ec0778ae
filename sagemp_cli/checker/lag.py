"""A control that lags: of a state before its instant, in force after it (``docs/continuous_time.md``)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

LOOSE = 2.0**-40


@dataclass(frozen=True)
class Lag:
    """Least and most seconds.

    Attributes:
        delay: d_k; the control of the instant before is in force until then.
        jitter: j_k; so much older is what is measured.
    """

    delay: tuple[float, float]
    jitter: tuple[float, float]

    @classmethod
    def of(cls, sides: Sequence[Sequence[float]], period: float) -> Lag:
        """Of a period's seconds.

        Raises:
            ValueError: no bounds, or of more than a period together.
        """
        pairs = [(float(least), float(most)) for least, most in sides]
        if len(pairs) != 2 or not all(0 <= least <= most < math.inf for least, most in pairs):
            raise ValueError("the bounds of a control's delay and jitter are no two intervals of seconds")
        delay, jitter = pairs
        if Fraction(delay[1]) + Fraction(jitter[1]) > Fraction(period):
            raise ValueError(f"delay and jitter are {delay[1]} s and {jitter[1]} s, more than a period")
        return cls(delay, jitter)

    def parts(self, period: float, substeps: int) -> int:
        """How many parts of a period a delay may reach into."""
        length = Fraction(period) / substeps
        return sum(1 for j in range(substeps) if j * length < Fraction(self.delay[1]))

    def since(self, period: float, substeps: int) -> int:
        """The first part of a period that a measurement at its end may be of."""
        length, first = Fraction(period) / substeps, Fraction(period) - Fraction(self.jitter[1])
        return max(j for j in range(substeps) if j * length <= first)

    def share(self, j: int, period: float, substeps: int) -> tuple[Fraction, Fraction]:
        """Bounds of the share of part j in which the control before is in force."""
        length = Fraction(period) / substeps
        least, most = (min(max((Fraction(d) - j * length) / length, Fraction(0)), Fraction(1)) for d in self.delay)
        return least, most

    def means(self, j: int, period: float, substeps: int) -> tuple[tuple[float, float], tuple[float, float]]:
        """Bounds of its weight in the two means of part j, as the float64 numbers that a record rests on.

        Raises:
            ValueError: they do not hold the exact ones.
        """
        h = period / substeps
        low, high = (min(max((d - j * h) / h, 0.0), 1.0) for d in self.delay)
        first = max(low * (2 - low) - LOOSE, 0.0), min(high * (2 - high) + LOOSE, 1.0)
        last = max(low * low - LOOSE, 0.0), min(high * high + LOOSE, 1.0)
        least, most = self.share(j, period, substeps)
        exact = (least * (2 - least), most * (2 - most)), (least * least, most * most)
        for (a, b), (c, d) in zip((first, last), exact, strict=True):
            if not (Fraction(a) <= c and d <= Fraction(b)):
                raise ValueError("the shares of a lagging control are out of reach of float64")
        return first, last
