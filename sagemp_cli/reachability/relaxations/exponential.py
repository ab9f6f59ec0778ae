"""Exponential: convex."""

from __future__ import annotations

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations import pieces
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.reachability.relaxations.pieces import Curve, Piece
from sagemp_cli.reachability.relaxations.value_range import increasing

ULPS = 4
"""Margin for ``torch.exp``, in ulps of the result; tested against ball arithmetic."""

CURVE = Curve(
    torch.exp,
    torch.exp,
    (Piece(-torch.inf, torch.inf, True, lambda slope, start, end: torch.log(slope.clamp(min=1e-300))),),
    ULPS,
)


def band(lower: Tensor, upper: Tensor) -> Band:
    """Band of ``exp`` on ``[lower, upper]``; none beyond 709, where float64 ends."""
    return pieces.band(CURVE, lower, upper)


def lines(lower: Tensor, upper: Tensor) -> Lines:
    """Lines of ``exp`` on ``[lower, upper]``."""
    return pieces.lines(CURVE, lower, upper)


def value_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of ``exp`` on ``[lower, upper]``."""
    return increasing(torch.exp, lower, upper, ulps=ULPS, floor=0.0)
