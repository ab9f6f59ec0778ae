"""Arc tangent: convex left of 0, concave right of it."""

from __future__ import annotations

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations import pieces
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.reachability.relaxations.pieces import Curve, Piece
from sagemp_cli.reachability.relaxations.value_range import increasing

ULPS = 4
"""Margin for ``torch.atan`` and the derivative below, in ulps of the result; tested against ball arithmetic."""


def _derivative(x: Tensor) -> Tensor:
    return 1.0 / (1.0 + x * x)


def _touch(slope: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """``sqrt(1 / slope - 1)``."""
    a = slope.clamp(1e-300, 1.0)
    return torch.sqrt((1.0 - a) / a)


CURVE = Curve(
    torch.atan,
    _derivative,
    (
        Piece(-torch.inf, 0.0, True, lambda slope, start, end: -_touch(slope, start, end)),
        Piece(0.0, torch.inf, False, _touch),
    ),
    ULPS,
)


def band(lower: Tensor, upper: Tensor) -> Band:
    """Band of ``atan`` on ``[lower, upper]``."""
    return pieces.band(CURVE, lower, upper)


def lines(lower: Tensor, upper: Tensor) -> Lines:
    """Lines of ``atan`` on ``[lower, upper]``."""
    return pieces.lines(CURVE, lower, upper)


def value_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of ``atan`` on ``[lower, upper]``."""
    return increasing(torch.atan, lower, upper, ulps=ULPS)
