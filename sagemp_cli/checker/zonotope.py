"""The set of states at one step, ``center + G [-1, 1]^M``, and what can be read off it.

The centre is exact. The generators, thousands of columns, are exact float64 numbers; what is lost in a product with
them is bounded beforehand and kept (a midpoint-radius matrix, Rump 1999). Used of float64: sums and products are
correctly rounded, in whatever order a sum of products is taken, so that a sum of n products errs by at most
``n u / (1 - n u)`` times the sum of their absolute values (Higham 2002, section 3.1), ``u = 2^-53``, plus underflow;
and of python-flint: ``float`` of a ball is within one unit in the last place of its midpoint.

Rows. A value that depends on the states and on q further variables in [-1, 1] is a row ``[c, a_1..a_n, b_1..b_q]`` of
balls: ``c + a (x - center) + b [-1, 1]^q``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from sagemp_cli.checker.balls import Unproved, arb, arb_mat, balls, upper_float

_EPS = 2.0**-52  # twice the unit roundoff: absorbs the 1 / (1 - n u)
_UP = 1.0 + 2.0**-20  # more than what rounding does to a bound of a loss while it is computed
_UNDERFLOW = 2.0**-900
_SMALLEST = 2.0**-1070  # an entry of a row that underflows, times what it multiplies


class Zonotope:
    """See the module.

    Attributes:
        center: n balls, exact.
        generators: ``(n, M)``.
        reach: upper bounds of ``sum_j |G_ij|``, ``(n,)``.
    """

    def __init__(self, center: Sequence[arb], generators: np.ndarray) -> None:
        self.center = [c.mid() for c in center]
        self.generators = generators
        self.reach = _sums(generators)
        if not np.isfinite(self.reach).all():
            raise Unproved("a bound overflowed")

    @classmethod
    def box(cls, lower: Iterable[float], upper: Iterable[float]) -> Zonotope:
        """One that contains a box: the box itself up to rounding of its radii."""
        low, high = balls(lower), balls(upper)
        center = [((a + b) / 2).mid() for a, b in zip(low, high, strict=True)]
        radius = [upper_float((b - c).max(c - a)) if a != b else 0.0 for a, b, c in zip(low, high, center, strict=True)]
        return cls(center, np.diag(radius))

    def bounds(self) -> list[tuple[arb, arb]]:
        """Lower and upper bound of each state."""
        return [(c - r, c + r) for c, r in zip(self.center, map(arb, self.reach.tolist()), strict=True)]

    def radii(self, rows: arb_mat) -> list[arb]:
        """Upper bounds of how far the values of rows may be from their ``c``."""
        matrix, lost = self._rounded(rows)
        n = len(self.center)
        total = _sums(matrix[:, 1 : n + 1] @ self.generators) + _sums(matrix[:, n + 1 :])
        return [arb(r) for r in (total * (1 + 4 * _EPS) + lost).tolist()]

    def image(self, rows: arb_mat) -> Zonotope:
        """The set of n values. Its columns: the old ones mapped, one for each further variable, and one for each
        state with all that was rounded.
        """
        matrix, lost = self._rounded(rows)
        n = len(self.center)
        center = [rows[i, 0] for i in range(n)]
        errors = [upper_float(arb(e) + c.rad()) for e, c in zip(lost.tolist(), center, strict=True)]
        return Zonotope(
            center, np.hstack([matrix[:, 1 : n + 1] @ self.generators, matrix[:, n + 1 :], np.diag(errors)])
        )

    def reduced(self, kept: np.ndarray) -> Zonotope:
        """The columns of a mask, and a box around the sum of the others."""
        if kept.all():
            return self
        others = np.diag(_sums(self.generators[:, ~kept]))
        return Zonotope(self.center, np.hstack([self.generators[:, kept], others]))

    def _rounded(self, rows: arb_mat) -> tuple[np.ndarray, np.ndarray]:
        """Rows as float64, and per row what rounding them and multiplying them with the generators loses at most."""
        n, width = len(self.center), rows.ncols()
        matrix = np.array([float(a) for a in rows.entries()]).reshape(rows.nrows(), width)
        weights = np.concatenate([[0.0], self.reach, np.ones(width - n - 1)])
        balls_left = (rows - rows.mid()) * arb_mat(width, 1, weights.tolist())  # entries are balls around 0
        lost = np.array([float(b.abs_upper()) for b in balls_left.entries()])
        lost = (lost + np.abs(matrix) @ weights * ((n + 4) * _EPS)) * _UP + (weights.sum() * _SMALLEST + _UNDERFLOW)
        if not np.isfinite(lost).all():
            raise Unproved("a bound overflowed")
        return matrix, lost


def _sums(rows: np.ndarray) -> np.ndarray:
    """Upper bounds of the sums of absolute values of rows of float64 numbers."""
    return np.abs(rows).sum(axis=1) * (1 + (rows.shape[1] + 4) * _EPS)
