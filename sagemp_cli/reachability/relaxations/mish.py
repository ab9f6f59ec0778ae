"""Mish ``x tanh(log(1 + exp x))``: concave, convex between its two inflections, concave.

With ``n = exp(x) (exp(x) + 2)`` the factor of x is ``n / (n + 2)``.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations import pieces
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.reachability.relaxations.pieces import Curve, Piece
from sagemp_cli.reachability.relaxations.touching import by_regula_falsi
from sagemp_cli.reachability.relaxations.value_range import dipped

ULPS = 6
"""Margin for the formulas below, in ulps of the result; tested against ball arithmetic."""

INFLECTIONS = (-2.256376396360793, 1.4905711794854284)
LOWEST = -1.1924312145154952
"""Where the function is smallest; all three are tested against ball arithmetic."""


def _value(x: Tensor) -> Tensor:
    q = torch.exp(-x.abs())
    more, less = 1.0 + 2.0 * q, q * (q + 2.0)
    return x * torch.where(x >= 0, more / (more + 2.0 * q * q), less / (less + 2.0))


def _derivative(x: Tensor) -> Tensor:
    q = torch.exp(-x.abs())
    more, less = 1.0 + 2.0 * q, q * (q + 2.0)
    over, under = more + 2.0 * q * q, less + 2.0
    factor = torch.where(x >= 0, more / over, less / under)
    rise = 4.0 * q * (1.0 + q) / torch.where(x >= 0, over * over / q.clamp(min=1e-300), under * under)
    return factor + x * rise


_touch = by_regula_falsi(_derivative)
CURVE = Curve(
    _value,
    _derivative,
    (
        Piece(-math.inf, INFLECTIONS[0], False, _touch),
        Piece(INFLECTIONS[0], INFLECTIONS[1], True, _touch),
        Piece(INFLECTIONS[1], math.inf, False, _touch),
    ),
    ULPS,
    derivative_floor=2.0,
)


def band(lower: Tensor, upper: Tensor) -> Band:
    """Band of mish on ``[lower, upper]``."""
    return pieces.band(CURVE, lower, upper)


def lines(lower: Tensor, upper: Tensor) -> Lines:
    """Lines of mish on ``[lower, upper]``."""
    return pieces.lines(CURVE, lower, upper)


def value_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of mish on ``[lower, upper]``."""
    return dipped(_value, LOWEST, lower, upper, ulps=ULPS)
