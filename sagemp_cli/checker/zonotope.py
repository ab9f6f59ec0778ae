"""The set of states at one step, ``center + G [-1, 1]^M``, and what can be read off it.

The centre is exact. The generators, thousands of columns, are exact float64 numbers; whatever a product with them
loses goes into the result as a bound (a midpoint-radius matrix, Rump 1999). Used of float64: every sum and product
is correctly rounded, in whatever order a sum of products is taken, so that a sum of n products errs by at most
``n u / (1 - n u)`` times the sum of their absolute values (Higham 2002, section 3.1), u = 2^-53, plus underflow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sagemp_cli.checker.balls import Unproved, arb, ball, balls, nearest, upper_float

_EPS = 2.0**-52  # twice the unit roundoff: absorbs the 1 / (1 - n u)
_UNDERFLOW = 2.0**-900


class Zonotope:
    """See the module.

    Attributes:
        center: n balls, exact.
        generators: ``(n, M)`` float64.
        reach: upper bounds of ``sum_j |G_ij|``, n balls.
    """

    def __init__(self, center: Sequence[arb], generators: np.ndarray) -> None:
        if generators.size and not np.isfinite(generators).all():
            raise Unproved("a bound overflowed")
        self.center = [c.mid() for c in center]
        self.generators = generators
        self.reach = [self._total(row) for row in generators]

    @classmethod
    def box(cls, lower: Sequence[float], upper: Sequence[float]) -> Zonotope:
        """The smallest one around a box."""
        low, high = balls(lower), balls(upper)
        center = [((a + b) / 2).mid() for a, b in zip(low, high, strict=True)]
        radius = [upper_float((b - c).max(c - a)) if a != b else 0.0 for a, b, c in zip(low, high, center, strict=True)]
        return cls(center, np.diag(radius))

    def bounds(self) -> list[tuple[arb, arb]]:
        """Lower and upper bound of each state."""
        return [(c - r, c + r) for c, r in zip(self.center, self.reach, strict=True)]

    def radii(self, rows: Sequence[Mapping[int, arb]]) -> list[arb]:
        """Upper bounds of ``|row . (x - center)|`` over the set, for rows given by their nonzero coefficients."""
        matrix, lost = self._rounded(rows)
        sums = np.abs(matrix @ self.generators)
        return [self._total(s) + loss for s, loss in zip(sums, lost, strict=True)]

    def image(self, center: Sequence[arb], rows: Sequence[Mapping[int, arb]], fresh: Sequence[Sequence[arb]]) -> Zonotope:
        """The set of ``center + rows (x - old center) + fresh [-1, 1]^l``.

        Its columns: the old ones mapped, the l fresh ones, and one for each state with everything that was rounded.
        """
        matrix, lost = self._rounded(rows)
        own = np.zeros((len(rows), len(fresh[0])))
        for i, entries in enumerate(fresh):
            lost[i] += center[i].rad()
            for j, entry in enumerate(entries):
                own[i, j], distance = nearest(entry)
                lost[i] += distance
        errors = np.diag([upper_float(e) for e in lost])
        return Zonotope(center, np.hstack([matrix @ self.generators, own, errors]))

    def reduced(self, kept: np.ndarray) -> Zonotope:
        """The columns of a mask, and a box around the sum of the others."""
        others = self.generators[:, ~kept]
        radius = [upper_float(self._total(row)) for row in others]
        return Zonotope(self.center, np.hstack([self.generators[:, kept], np.diag(radius)]))

    def _rounded(self, rows: Sequence[Mapping[int, arb]]) -> tuple[np.ndarray, list[arb]]:
        """Rows as float64, and per row what the rounding of the rows and of their product with G loses."""
        n = len(self.center)
        matrix, lost = np.zeros((len(rows), n)), []
        for i, row in enumerate(rows):
            loss = ball(_UNDERFLOW)
            for j, coefficient in row.items():
                matrix[i, j], distance = nearest(coefficient)
                loss += (distance + ball(abs(matrix[i, j])) * ball((n + 2) * _EPS)) * self.reach[j]
            lost.append(loss)
        return matrix, lost

    @staticmethod
    def _total(row: np.ndarray) -> arb:
        """An upper bound of the sum of absolute values of float64 numbers."""
        if not row.any():
            return ball(0.0)
        return (ball(np.abs(row).sum()) * (1 + ball((row.size + 2) * _EPS)) + ball(_UNDERFLOW)).upper()
