"""Error function ``erf``: convex left of 0, concave right of it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations import pieces
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.reachability.relaxations.pieces import Curve, Piece
from sagemp_cli.reachability.relaxations.value_range import increasing

ULPS = 4
"""Margin for ``torch.erf``, in ulps of the result; tested against ball arithmetic."""

_STEEPEST = 2.0 / math.sqrt(math.pi)


def _derivative(x: Tensor) -> Tensor:
    return _STEEPEST * torch.exp(-x * x)


def _touch(slope: Tensor, start: Tensor, end: Tensor) -> Tensor:
    return torch.sqrt(-torch.log((slope / _STEEPEST).clamp(1e-300, 1.0)))


CURVE = Curve(
    torch.erf,
    _derivative,
    (
        Piece(-math.inf, 0.0, True, lambda slope, start, end: -_touch(slope, start, end)),
        Piece(0.0, math.inf, False, _touch),
    ),
    ULPS,
    derivative_floor=1.0,
)


def band(lower: Tensor, upper: Tensor) -> Band:
    """Band of ``erf`` on ``[lower, upper]``."""
    return pieces.band(CURVE, lower, upper)


def lines(lower: Tensor, upper: Tensor) -> Lines:
    """Lines of ``erf`` on ``[lower, upper]``."""
    return pieces.lines(CURVE, lower, upper)


def value_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of ``erf`` on ``[lower, upper]``."""
    return increasing(torch.erf, lower, upper, ulps=ULPS)
