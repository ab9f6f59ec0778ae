"""What float32 arithmetic may make of a number, in balls: the number and an error around it.

``docs/program.md`` has the errors and what is assumed. Here u is ``2^-24``. One rounding errs by at most ``u |a| +
2^-126``, a function of a library by at most ``8 u (1 + |a|)``. A sum of c products and a bias errs, in whatever order
it is taken, by at most ``(1 + u)^k - 1`` times the sum of the terms' sizes, where ``k = c + 1`` is the most roundings
that a term goes through, and by what 2 k results lose that are too small, each at most 2^-126 times what later
roundings make of it. A number of 2^126 or more may overflow on the way, so that nothing is known of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sagemp_cli.checker.balls import arb, arb_mat
from sagemp_cli.checker.unproved import Unproved

_UNIT = arb(2.0**-24)
_SMALLEST = arb(2.0**-126)
_LARGEST = arb(2.0**126)
_MOST_TERMS = 2**22


def _limited(size: arb, error: arb) -> arb:
    if not size < _LARGEST:
        raise Unproved("a float32 number may overflow")
    return error.upper()


def of_sums(size: arb, terms: int) -> arb:
    """Error of a sum of so many products and a bias, from the sum of their sizes."""
    if terms >= _MOST_TERMS:
        raise Unproved(f"a float32 sum has {terms} terms, more than {_MOST_TERMS}")
    k = terms + 1
    grown = (1 + _UNIT) ** k
    return _limited(size, (grown - 1) * size + 2 * k * _SMALLEST * grown)


def sizes(matrix: arb_mat, bias: Sequence[arb], ends: Sequence[tuple[arb, arb]]) -> list[arb]:
    """Bounds of ``|M| |a| + |b|``, a between its ends."""
    most = [abs(low).max(abs(high)) for low, high in ends]
    absolute = arb_mat(matrix.nrows(), matrix.ncols(), [abs(w) for w in matrix.entries()])
    products = (absolute * arb_mat(len(most), 1, most)).entries()
    return [(p + abs(b)).upper() for p, b in zip(products, bias, strict=True)]


@dataclass(frozen=True)
class Rounding:
    """A number and an error around it: a function of which only that is known.

    Attributes:
        relative, absolute: the error is at most ``relative |a| + absolute``.
    """

    relative: arb
    absolute: arb

    def error(self, size: arb) -> arb:
        """Of a number of that size."""
        return _limited(size, self.relative * size + self.absolute)

    def excess(self, slope: arb, lower: arb, upper: arb) -> tuple[arb, arb]:
        """Bounds of ``f(x) - slope x`` over ``[lower, upper]``."""
        return around(slope, lower, upper, self.error(abs(lower).max(abs(upper)).upper()))

    def value(self, x: arb) -> arb:
        """All that a number may become."""
        return x + arb(0, self.error(abs(x).upper()))


def around(slope: arb, lower: arb, upper: arb, error: arb) -> tuple[arb, arb]:
    """Bounds of ``x + e - slope x`` for x between its ends and e of at most that error."""
    ends = [(1 - slope) * x for x in (lower, upper)]
    return ends[0].min(ends[1]) - error, ends[0].max(ends[1]) + error


ROUNDINGS = {"float32": Rounding(_UNIT, _SMALLEST), "float32_near": Rounding(8 * _UNIT, 8 * _UNIT)}
