"""Hyperbolic tangent: convex left of 0, concave right of it."""

from __future__ import annotations

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations import pieces
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.reachability.relaxations.pieces import Curve, Piece
from sagemp_cli.reachability.relaxations.value_range import increasing

ULPS = 4
"""Margin for ``torch.tanh`` and the derivative below, in ulps of the result; tested against ball arithmetic."""


def _derivative(x: Tensor) -> Tensor:
    """``4 q / (1 + q)^2`` with ``q = exp(-2 |x|)``: unlike ``1 - tanh^2`` accurate in the tails."""
    q = torch.exp(-2.0 * x.abs())
    return 4.0 * q / (1.0 + q).square()


def _touch(slope: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """``acosh(1 / sqrt(slope))``."""
    a = slope.clamp(1e-300, 1.0)
    return torch.log((1.0 + torch.sqrt(1.0 - a)) / torch.sqrt(a))


CURVE = Curve(
    torch.tanh,
    _derivative,
    (
        Piece(-torch.inf, 0.0, True, lambda slope, start, end: -_touch(slope, start, end)),
        Piece(0.0, torch.inf, False, _touch),
    ),
    ULPS,
)


def band(lower: Tensor, upper: Tensor) -> Band:
    """Band of ``tanh`` on ``[lower, upper]``."""
    return pieces.band(CURVE, lower, upper)


def lines(lower: Tensor, upper: Tensor) -> Lines:
    """Lines of ``tanh`` on ``[lower, upper]``."""
    return pieces.lines(CURVE, lower, upper)


def value_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of ``tanh`` on ``[lower, upper]``."""
    return increasing(torch.tanh, lower, upper, ulps=ULPS)
