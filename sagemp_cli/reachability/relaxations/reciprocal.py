"""Reciprocal ``1 / x``: concave left of its pole, convex right of it. An interval that holds 0 has no band."""

from __future__ import annotations

import math

from torch import Tensor

from sagemp_cli.reachability.relaxations import pieces, power
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.functions import functions_of
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.reachability.relaxations.pieces import Curve, Piece

ULPS = 2
"""Margin for the derivative ``-(1 / x)^2``: two correctly rounded operations, and one that counts twice."""

UNDERFLOW = 1e-300
"""Far above what the derivative is off by where it underflows, which the margin makes smaller again."""


def band(lower: Tensor, upper: Tensor) -> Band:
    """Band of ``1 / x`` on ``[lower, upper]``; of tensors or of arrays."""
    return pieces.band(_CURVE, lower, upper, allowed=_allowed(lower, upper))


def lines(lower: Tensor, upper: Tensor) -> Lines:
    """Lines of ``1 / x`` on ``[lower, upper]``."""
    return pieces.lines(_CURVE, lower, upper, allowed=_allowed(lower, upper))


def value_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of ``1 / x`` on ``[lower, upper]``, infinite if 0 is in it."""
    return power.value_range(lower, upper, -1)


def _allowed(lower: Tensor, upper: Tensor) -> Tensor:
    return (lower > 0) | (upper < 0)


def _derivative(x: Tensor) -> Tensor:
    value = 1.0 / x
    return -(value * value)


def _left(slope: Tensor, start: Tensor, end: Tensor) -> Tensor:
    return -_right(slope, start, end)


def _right(slope: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Where the derivative is the slope."""
    return 1.0 / functions_of(slope).sqrt(abs(slope))


_CURVE = Curve(
    lambda x: 1.0 / x,
    _derivative,
    (Piece(-math.inf, 0.0, False, _left), Piece(0.0, math.inf, True, _right)),
    ULPS,
    derivative_floor=UNDERFLOW,
)
