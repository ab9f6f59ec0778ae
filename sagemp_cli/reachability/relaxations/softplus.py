"""Softplus ``log(1 + exp(beta x)) / beta``: convex.

torch returns x itself where ``beta x > threshold``. What is enclosed is both, the smooth function and torch's: up to
the jump of ``log(1 + exp(-threshold)) / beta`` (2e-9 by default) lower where the interval reaches the threshold.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations import pieces
from sagemp_cli.reachability.relaxations.band import Band, settled
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.reachability.relaxations.pieces import Curve, Piece
from sagemp_cli.reachability.relaxations.value_range import increasing
from sagemp_cli.sets.rounding import TINY, gamma, slack

ULPS = 4
"""Margin for the formulas below, in ulps of the result; tested against ball arithmetic."""


def _value(z: Tensor) -> Tensor:
    return z.clamp(min=0.0) + torch.log1p(torch.exp(-z.abs()))


def _derivative(z: Tensor) -> Tensor:
    """The logistic function, accurate in both tails."""
    q = torch.exp(-z.abs())
    return torch.where(z >= 0, torch.ones_like(q), q) / (1.0 + q)


def _touch(slope: Tensor, start: Tensor, end: Tensor) -> Tensor:
    a = slope.clamp(1e-300, 1.0 - gamma(1))
    return torch.log(a / (1.0 - a))


CURVE = Curve(_value, _derivative, (Piece(-math.inf, math.inf, True, _touch),), ULPS)
"""Softplus with beta 1; others are this one with scaled argument and value."""


def band(lower: Tensor, upper: Tensor, beta: float = 1.0, threshold: float = 20.0) -> Band:
    """Band of softplus (torch's and the smooth one) on ``[lower, upper]``, ``beta > 0``."""
    z_lower, z_upper = _scaled(lower, upper, beta)
    slope, offset, radius = pieces.band(CURVE, z_lower, z_upper)
    half = 0.5 * _jump(z_upper, threshold)
    offset, radius = (offset - half) / beta, (radius + half) / beta
    return settled(slope, offset, radius + slack(offset.abs() + radius, 8) + TINY)


def lines(lower: Tensor, upper: Tensor, beta: float = 1.0, threshold: float = 20.0) -> Lines:
    """Lines of softplus (torch's and the smooth one) on ``[lower, upper]``, ``beta > 0``."""
    z_lower, z_upper = _scaled(lower, upper, beta)
    a, low, b, high = pieces.lines(CURVE, z_lower, z_upper)
    jump = _jump(z_upper, threshold)
    low, high = (low - jump) / beta, high / beta
    return Lines(a, low - slack(low.abs() + jump, 8) - TINY, b, high + slack(high.abs(), 8) + TINY)


def value_range(lower: Tensor, upper: Tensor, beta: float = 1.0, threshold: float = 20.0) -> tuple[Tensor, Tensor]:
    """Bounds of softplus (torch's and the smooth one) on ``[lower, upper]``, ``beta > 0``."""
    z_lower, z_upper = _scaled(lower, upper, beta)
    low, high = increasing(_value, z_lower, z_upper, ulps=ULPS)
    return (
        ((low - _jump(z_upper, threshold)) / beta - slack(low.abs() / beta, 8) - TINY).clamp(min=0.0),
        high / beta * (1 + gamma(8)) + TINY,
    )


def _scaled(lower: Tensor, upper: Tensor, beta: float) -> tuple[Tensor, Tensor]:
    """``beta x``, rounded outwards."""
    if beta == 1:
        return lower, upper
    low, high = beta * lower, beta * upper
    return low - (slack(low.abs(), 2) + TINY), high + (slack(high.abs(), 2) + TINY)


def _jump(z_upper: Tensor, threshold: float) -> Tensor:
    """How far torch's function may lie below the smooth one."""
    jump = math.log1p(math.exp(-threshold)) * (1 + 1e-12)
    return (z_upper * (1 + gamma(8)) > threshold).to(z_upper) * jump
