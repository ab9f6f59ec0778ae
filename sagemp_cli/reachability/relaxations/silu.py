"""SiLU (swish) ``x sigmoid(x)``: concave, convex between its two inflections, concave."""

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


def _solve(slope: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Where the derivative, monotone on the piece, is nearest to the slope: regula falsi, Illinois variant."""
    left, right = start, end
    at_left, at_right = _derivative(left) - slope, _derivative(right) - slope
    beyond, nearest = at_left * at_right > 0, torch.where(at_left.abs() < at_right.abs(), left, right)
    t, near, before = left, 1e-6 * (at_right - at_left).abs(), torch.zeros_like(left, dtype=torch.bool)
    for i in range(10):
        drop = at_right - at_left
        t = torch.where(drop == 0, left, right - at_right * (right - left) / drop)
        t = torch.minimum(torch.fmax(t, left), right)
        at = _derivative(t) - slope
        if bool((beyond | (at.abs() <= near)).all()):
            break
        # The end that stays for the second time counts half.
        same = (at > 0) == (at_right > 0)
        stays = torch.where(same == before, 0.5, 1.0) if i else 1.0
        left, at_left = torch.where(same, left, t), torch.where(same, at_left * stays, at)
        right, at_right = torch.where(same, t, right), torch.where(same, at, at_right * stays)
        before = same
    return torch.where(beyond, nearest, t)


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
    first, last = _value(lower), _value(upper)
    inside = _value(torch.minimum(lower.clamp(min=LOWEST), upper))
    return outward(torch.minimum(torch.minimum(first, last), inside), torch.maximum(first, last), ulps=ULPS)
