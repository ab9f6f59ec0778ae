"""SiLU (swish) ``x sigmoid(x)``: concave, convex between its two inflections, concave."""

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

ULPS = 4
"""Margin for the formulas below, in ulps of the result; tested against ball arithmetic."""

INFLECTION = 2.3993572805154677
"""Where ``x tanh(x / 2) = 2``."""

LOWEST = -1.2784645427610738
"""Where the function is smallest; both are tested against ball arithmetic."""


def _logistic(x: Tensor) -> Tensor:
    q = torch.exp(-x.abs())
    return torch.where(x >= 0, torch.ones_like(q), q) / (1.0 + q)


def _value(x: Tensor) -> Tensor:
    return x * _logistic(x)


def _derivative(x: Tensor) -> Tensor:
    q = torch.exp(-x.abs())
    d = 1.0 + q
    return (torch.where(x >= 0, torch.ones_like(q), q) + x * (q / d)) / d


_solve = by_regula_falsi(_derivative)

CURVE = Curve(
    _value,
    _derivative,
    (
        Piece(-math.inf, -INFLECTION, False, _solve),
        Piece(-INFLECTION, INFLECTION, True, _solve),
        Piece(INFLECTION, math.inf, False, _solve),
    ),
    ULPS,
    derivative_floor=2.0,
)


def band(lower: Tensor, upper: Tensor) -> Band:
    """Band of SiLU on ``[lower, upper]``."""
    return pieces.band(CURVE, lower, upper)


def lines(lower: Tensor, upper: Tensor) -> Lines:
    """Lines of SiLU on ``[lower, upper]``."""
    return pieces.lines(CURVE, lower, upper)


def value_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of SiLU on ``[lower, upper]``."""
    return dipped(_value, LOWEST, lower, upper, ulps=ULPS)
