"""Natural logarithm: concave. An interval that reaches 0 has no band."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations import pieces
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.reachability.relaxations.pieces import Curve, Piece
from sagemp_cli.reachability.relaxations.value_range import outward

ULPS = 4
"""Margin for ``torch.log``, in ulps of the result; tested against ball arithmetic."""

_SMALLEST = 1e-300  # of arguments: below, the derivative comes near to what float64 can hold

CURVE = Curve(
    torch.log,
    torch.reciprocal,
    (Piece(-math.inf, math.inf, False, lambda slope, start, end: 1.0 / slope.clamp(min=1e-300)),),
    ULPS,
)


def band(lower: Tensor, upper: Tensor) -> Band:
    """Band of ``log`` on ``[lower, upper]``."""
    return pieces.band(CURVE, lower, upper, allowed=lower >= _SMALLEST)


def lines(lower: Tensor, upper: Tensor) -> Lines:
    """Lines of ``log`` on ``[lower, upper]``."""
    return pieces.lines(CURVE, lower, upper, allowed=lower >= _SMALLEST)


def value_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of ``log`` on ``[lower, upper]``; nothing is claimed of an interval with negative numbers."""
    low, high = outward(torch.log(lower), torch.log(upper), ulps=ULPS)
    return low, torch.where(lower >= 0, high, torch.full_like(high, math.inf))
