"""Powers ``x^n``, square and reciprocal among them.

Even powers are convex (negative ones on either side of the pole); odd ones are concave left of 0 and convex right of
it. Powers that are not whole are those of ``x >= 0``, concave for an exponent between 0 and 1 and else convex. An
interval that holds the pole of a negative power, or reaches out of the domain, has no band.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations import pieces
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.reachability.relaxations.pieces import Curve, Piece
from sagemp_cli.reachability.relaxations.value_range import outward

ULPS = 4
"""Margin for ``torch.pow``, in ulps of the result; tested against ball arithmetic."""

_SMALLEST = (
    1e-280  # upper ends of intervals for a power that is not whole: below, its slope may be too large for float64
)


def band(lower: Tensor, upper: Tensor, exponent: float) -> Band:
    """Band of ``x^exponent`` on ``[lower, upper]``; the exponent is neither 0 nor 1."""
    return pieces.band(_curve(exponent), lower, _raised(upper, exponent), allowed=_allowed(lower, upper, exponent))


def lines(lower: Tensor, upper: Tensor, exponent: float) -> Lines:
    """Lines of ``x^exponent`` on ``[lower, upper]``; the exponent is neither 0 nor 1."""
    return pieces.lines(_curve(exponent), lower, _raised(upper, exponent), allowed=_allowed(lower, upper, exponent))


def value_range(lower: Tensor, upper: Tensor, exponent: float) -> tuple[Tensor, Tensor]:
    """Bounds of ``x^exponent`` on ``[lower, upper]``, infinite if there is a pole or the domain is left."""
    if exponent % 1:
        low, high = outward(*_sorted(torch.pow(lower, exponent), torch.pow(upper, exponent)), ulps=ULPS, floor=0.0)
        return low, torch.where(_within(lower, exponent), high, torch.full_like(high, math.inf))
    first, last = torch.pow(lower, exponent), torch.pow(upper, exponent)
    least, most = torch.minimum(first, last), torch.maximum(first, last)
    within = (lower <= 0) & (upper >= 0)
    if exponent < 0:
        least = torch.where(within, torch.full_like(least, math.nan), least)
        most = torch.where(within, torch.full_like(most, math.nan), most)
    elif exponent % 2 == 0:
        least = torch.where(within, torch.zeros_like(least), least)
    low, high = outward(least, most, ulps=ULPS)
    if exponent % 2 == 0:
        return low.clamp(min=0.0), high
    return torch.where(lower >= 0, low.clamp(min=0.0), low), torch.where(upper <= 0, high.clamp(max=0.0), high)


def _allowed(lower: Tensor, upper: Tensor, exponent: float) -> Tensor | None:
    if exponent % 1:
        return _within(lower, exponent)
    return (lower > 0) | (upper < 0) if exponent < 0 else None


def _within(lower: Tensor, exponent: float) -> Tensor:
    """Whether the domain of a power that is not whole is kept."""
    return lower >= 0 if exponent > 0 else lower > 0


def _sorted(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    return torch.minimum(a, b), torch.maximum(a, b)


def _raised(upper: Tensor, exponent: float) -> Tensor:
    """A larger interval where that of a power that is not whole is next to nothing."""
    return upper.clamp(min=_SMALLEST) if exponent % 1 else upper


@functools.cache
def _curve(exponent: float) -> Curve:
    n = exponent

    def value(x: Tensor) -> Tensor:
        return torch.pow(x, n)

    def derivative(x: Tensor) -> Tensor:
        return n * torch.pow(x if n % 1 == 0 else x.clamp(min=1e-300), n - 1)

    def size(slope: Tensor) -> Tensor:
        """``|x|`` where the derivative is the slope, or minus it."""
        return torch.pow((slope / n).abs(), 1.0 / (n - 1))

    def right(slope: Tensor, start: Tensor, end: Tensor) -> Tensor:
        return size(slope)

    def left(slope: Tensor, start: Tensor, end: Tensor) -> Tensor:
        return -size(slope)

    def either(slope: Tensor, start: Tensor, end: Tensor) -> Tensor:
        """Even powers: the derivative has the sign of x if n > 0, the other one if n < 0."""
        return torch.copysign(size(slope), slope if n > 0 else -slope)

    def inside(slope: Tensor, start: Tensor, end: Tensor) -> Tensor:
        """Of a power that is not whole; not at 0, where the tangent may be vertical."""
        return torch.fmax(size((slope / n).clamp(min=1e-300) * n), 1e-12 * end)

    if n % 1:
        return Curve(value, derivative, (Piece(-math.inf, math.inf, not 0 < n < 1, inside),), ULPS)
    if n % 2 == 0:
        return Curve(value, derivative, (Piece(-math.inf, math.inf, True, either),), ULPS)
    return Curve(value, derivative, (Piece(-math.inf, 0.0, False, left), Piece(0.0, math.inf, True, right)), ULPS)
