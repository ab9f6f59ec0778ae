"""Softsign ``x / (1 + |x|)``: convex left of 0, concave right of it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations import pieces
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.reachability.relaxations.pieces import Curve, Piece
from sagemp_cli.reachability.relaxations.value_range import increasing

ULPS = 2
"""Margin for the formulas below: two correctly rounded operations, or three; tested against ball arithmetic."""


def _value(x: Tensor) -> Tensor:
    return x / (1.0 + x.abs())


def _derivative(x: Tensor) -> Tensor:
    return (1.0 / (1.0 + x.abs())).square()


def _touch(slope: Tensor, start: Tensor, end: Tensor) -> Tensor:
    return 1.0 / torch.sqrt(slope.clamp(1e-300, 1.0)) - 1.0


CURVE = Curve(
    _value,
    _derivative,
    (
        Piece(-math.inf, 0.0, True, lambda slope, start, end: -_touch(slope, start, end)),
        Piece(0.0, math.inf, False, _touch),
    ),
    ULPS,
)


def band(lower: Tensor, upper: Tensor) -> Band:
    """Band of softsign on ``[lower, upper]``."""
    return pieces.band(CURVE, lower, upper)


def lines(lower: Tensor, upper: Tensor) -> Lines:
    """Lines of softsign on ``[lower, upper]``."""
    return pieces.lines(CURVE, lower, upper)


def value_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of softsign on ``[lower, upper]``."""
    return increasing(_value, lower, upper, ulps=ULPS)
