"""Tangent, between two of its poles: concave left of the multiple of pi between them, convex right of it.

An interval that holds a pole, or whose ends cannot be told apart from one, has no band.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations import pieces
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.reachability.relaxations.pieces import Curve, Piece
from sagemp_cli.reachability.relaxations.value_range import increasing

ULPS = 6
"""Margin for ``torch.tan`` and the derivative below, in ulps of the result; tested against ball arithmetic."""

# distance to a pole, relative to 1 + |x|, below which nothing is claimed: far above the rounding of multiples of pi
_POLE = 1e-12
_FAR = 1e9  # beyond this many rad, too


def _derivative(x: Tensor) -> Tensor:
    return 1.0 + torch.tan(x).square()


def _branch(lower: Tensor, upper: Tensor) -> tuple[Curve, Tensor]:
    """The curve around the interval's multiple of pi, and whether the interval lies between the poles next to it."""
    center = math.pi * torch.round((0.5 * lower + 0.5 * upper) / math.pi)
    room = 0.5 * math.pi - _POLE * (1.0 + center.abs())
    allowed = (lower - center > -room) & (upper - center < room) & (center.abs() < _FAR)

    def touch(slope: Tensor, start: Tensor, end: Tensor) -> Tensor:
        return torch.atan(torch.sqrt((slope - 1.0).clamp(min=0.0)))

    curve = Curve(
        torch.tan,
        _derivative,
        (
            Piece(-math.inf, center, False, lambda slope, start, end: center - touch(slope, start, end)),
            Piece(center, math.inf, True, lambda slope, start, end: center + touch(slope, start, end)),
        ),
        ULPS,
    )
    return curve, allowed


def band(lower: Tensor, upper: Tensor) -> Band:
    """Band of ``tan`` on ``[lower, upper]``."""
    curve, allowed = _branch(lower, upper)
    return pieces.band(curve, lower, upper, allowed=allowed)


def lines(lower: Tensor, upper: Tensor) -> Lines:
    """Lines of ``tan`` on ``[lower, upper]``."""
    curve, allowed = _branch(lower, upper)
    return pieces.lines(curve, lower, upper, allowed=allowed)


def value_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of ``tan`` on ``[lower, upper]``, infinite if there may be a pole."""
    _, allowed = _branch(lower, upper)
    low, high = increasing(torch.tan, lower, upper, ulps=ULPS)
    return torch.where(allowed, low, torch.full_like(low, -math.inf)), torch.where(
        allowed, high, torch.full_like(high, math.inf)
    )
