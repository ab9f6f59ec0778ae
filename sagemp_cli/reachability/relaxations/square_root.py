"""Square root: concave. An interval with negative numbers has no band."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations import pieces
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.reachability.relaxations.pieces import Curve, Piece
from sagemp_cli.reachability.relaxations.value_range import outward

ULPS = 2
"""Margin for ``torch.sqrt`` and the derivative below, in ulps of the result; tested against ball arithmetic."""

# where the tangent at 0 is vertical, the one used is that at this point; the graph rises above it by 1e-120 at most
_SMALLEST = 1e-240


def _derivative(x: Tensor) -> Tensor:
    return 0.5 / torch.sqrt(x.clamp(min=_SMALLEST))


CURVE = Curve(
    torch.sqrt,
    _derivative,
    (Piece(-math.inf, math.inf, False, lambda slope, start, end: 0.25 / slope.clamp(1e-150, 1e120).square()),),
    ULPS,
    floor=1e-119,
)


def band(lower: Tensor, upper: Tensor) -> Band:
    """Band of ``sqrt`` on ``[lower, upper]``."""
    return pieces.band(CURVE, lower, upper, allowed=lower >= 0)


def lines(lower: Tensor, upper: Tensor) -> Lines:
    """Lines of ``sqrt`` on ``[lower, upper]``."""
    return pieces.lines(CURVE, lower, upper, allowed=lower >= 0)


def value_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of ``sqrt`` on ``[lower, upper]``; nothing is claimed of an interval with negative numbers."""
    low, high = outward(torch.sqrt(lower), torch.sqrt(upper), ulps=ULPS, floor=0.0)
    return low, torch.where(lower >= 0, high, torch.full_like(high, math.inf))
