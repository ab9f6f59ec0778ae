"""Hardswish ``x clamp(x + 3, 0, 6) / 6``: 0 up to -3, the parabola ``x (x + 3) / 6``, x from 3 on.

Its kinks bend the other way than the parabola, so it is concave, convex, concave. The derivative at a kink is that of
the parabola, which bounds the straight piece beside it too; that piece's own is beside the kink.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations import pieces
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.reachability.relaxations.pieces import Curve, Piece
from sagemp_cli.reachability.relaxations.value_range import dipped

ULPS = 4
"""Margin for the formulas below, whose roundings are counted and few; tested against ball arithmetic."""

LOWEST = -1.5
_KINKS = math.nextafter(-3.0, -4.0), math.nextafter(3.0, 4.0)


def _value(x: Tensor) -> Tensor:
    y = x.clamp(-3.0, 3.0)
    return torch.where(x > 3, x, y * (y + 3.0) / 6.0)


def _derivative(x: Tensor) -> Tensor:
    inside = (x >= -3) & (x <= 3)
    return torch.where(inside, (2.0 * x + 3.0) / 6.0, (x > 3).to(x))


CURVE = Curve(
    _value,
    _derivative,
    (
        Piece(-math.inf, -3.0, False, lambda slope, start, end: torch.where(slope > 0, start, _KINKS[0])),
        Piece(-3.0, 3.0, True, lambda slope, start, end: 3.0 * slope - 1.5),
        Piece(3.0, math.inf, False, lambda slope, start, end: torch.where(slope > 1, _KINKS[1], end)),
    ),
    ULPS,
    derivative_floor=1.0,
)


def band(lower: Tensor, upper: Tensor) -> Band:
    """Band of hardswish on ``[lower, upper]``."""
    return pieces.band(CURVE, lower, upper)


def lines(lower: Tensor, upper: Tensor) -> Lines:
    """Lines of hardswish on ``[lower, upper]``."""
    return pieces.lines(CURVE, lower, upper)


def value_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of hardswish on ``[lower, upper]``."""
    return dipped(_value, LOWEST, lower, upper, ulps=ULPS)
