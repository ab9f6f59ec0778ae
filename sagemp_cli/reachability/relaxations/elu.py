"""ELU: ``x`` above 0, ``a (exp(x) - 1)`` below, with ``a > 0``; convex and smooth for a = 1.

For other a there is a kink at 0: convex for a < 1, and for a > 1 it bends the other way than the curve left of it. The
derivative at 0 is that of the left, and right of it the line's own.
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
from sagemp_cli.reachability.relaxations.value_range import increasing
from sagemp_cli.sets.rounding import TINY

ULPS = 4
"""Margin for ``torch.expm1`` and ``torch.exp`` and a product, in ulps of the result; tested against ball arithmetic."""


def band(lower: Tensor, upper: Tensor, alpha: float = 1.0) -> Band:
    """Band of ELU on ``[lower, upper]``."""
    return pieces.band(_curve(alpha), lower, upper)


def lines(lower: Tensor, upper: Tensor, alpha: float = 1.0) -> Lines:
    """Lines of ELU on ``[lower, upper]``."""
    return pieces.lines(_curve(alpha), lower, upper)


def value_range(lower: Tensor, upper: Tensor, alpha: float = 1.0) -> tuple[Tensor, Tensor]:
    """Bounds of ELU on ``[lower, upper]``."""
    return increasing(_curve(alpha).value, lower, upper, ulps=ULPS)


@functools.cache
def _curve(alpha: float) -> Curve:
    def value(x: Tensor) -> Tensor:
        return torch.where(x > 0, x, alpha * torch.expm1(x.clamp(max=0.0)))

    def derivative(x: Tensor) -> Tensor:
        return torch.where(x > 0, torch.ones_like(x), alpha * torch.exp(x.clamp(max=0.0)))

    def touch(slope: Tensor, start: Tensor, end: Tensor) -> Tensor:
        return torch.log((slope / alpha).clamp(1e-300, 1.0))

    if alpha == 1:
        return Curve(value, derivative, (Piece(-math.inf, math.inf, True, touch),), ULPS)

    def on_the_line(slope: Tensor, start: Tensor, end: Tensor) -> Tensor:
        """The end at which the line's excess is largest, or smallest; just right of the kink."""
        return torch.where((slope > 1) == (alpha > 1), torch.full_like(end, TINY), end)

    right = Piece(0.0, math.inf, alpha < 1, on_the_line)
    return Curve(value, derivative, (Piece(-math.inf, 0.0, True, touch), right), ULPS)
