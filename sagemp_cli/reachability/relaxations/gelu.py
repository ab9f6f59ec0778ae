"""GELU ``x P(x)``, P the standard normal distribution, and the form that torch calls tanh, which is close to it:
``x (1 + tanh(c (x + d x^3))) / 2``. Both are concave, convex between their two inflections, concave.
"""

from __future__ import annotations

import math
from collections.abc import Callable

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

FLOOR = 4e-16
"""What the values are off by besides: far below 0 the rounding of an exponent."""

INFLECTION, LOWEST = math.sqrt(2.0), -0.7517915246935645
"""Where GELU bends the other way, and where it is smallest; all four are tested against ball arithmetic."""

TANH_INFLECTION, TANH_LOWEST = 1.4185040087908283, -0.7524614220710162
"""The same of the tanh form."""

SCALE, CUBIC = math.sqrt(2.0 / math.pi), 0.044715
"""c and d of the tanh form: these float64 numbers, taken as exact."""

_FAR = 1e3  # beyond, in float64, the slope is 0 or 1


def _value(x: Tensor) -> Tensor:
    return 0.5 * x * torch.erfc(x * -math.sqrt(0.5))


def _derivative(x: Tensor) -> Tensor:
    return 0.5 * torch.erfc(x * -math.sqrt(0.5)) + x * torch.exp(-0.5 * x * x) * math.sqrt(0.5 / math.pi)


def _tanh_value(x: Tensor) -> Tensor:
    return x * _sided(x)[0]


def _tanh_derivative(x: Tensor) -> Tensor:
    y = x.clamp(-_FAR, _FAR)
    share, bend = _sided(x)
    return share + y * bend * (2.0 * SCALE * (1.0 + 3.0 * CUBIC * y * y))


def _sided(x: Tensor) -> tuple[Tensor, Tensor]:
    """The logistic function of ``2 c (x + d x^3)``, and its derivative there."""
    y = x.clamp(-_FAR, _FAR)
    q = torch.exp(-2.0 * SCALE * (y + CUBIC * y * y * y).abs())
    share = 1.0 / (1.0 + q)
    return torch.where(y >= 0, torch.ones_like(q), q) * share, q * share * share


def _curve(value: Callable[[Tensor], Tensor], derivative: Callable[[Tensor], Tensor], inflection: float) -> Curve:
    touch = by_regula_falsi(derivative)
    ends = (-math.inf, -inflection, inflection, math.inf)
    parts = tuple(Piece(ends[i], ends[i + 1], i == 1, touch) for i in range(3))
    return Curve(value, derivative, parts, ULPS, floor=FLOOR, derivative_floor=2.0)


CURVE = _curve(_value, _derivative, INFLECTION)
TANH_CURVE = _curve(_tanh_value, _tanh_derivative, TANH_INFLECTION)


def band(lower: Tensor, upper: Tensor) -> Band:
    """Band of GELU on ``[lower, upper]``."""
    return pieces.band(CURVE, lower, upper)


def lines(lower: Tensor, upper: Tensor) -> Lines:
    """Lines of GELU on ``[lower, upper]``."""
    return pieces.lines(CURVE, lower, upper)


def value_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of GELU on ``[lower, upper]``."""
    return dipped(_value, LOWEST, lower, upper, ulps=ULPS, absolute=FLOOR)


def tanh_band(lower: Tensor, upper: Tensor) -> Band:
    """Band of the tanh form on ``[lower, upper]``."""
    return pieces.band(TANH_CURVE, lower, upper)


def tanh_lines(lower: Tensor, upper: Tensor) -> Lines:
    """Lines of the tanh form on ``[lower, upper]``."""
    return pieces.lines(TANH_CURVE, lower, upper)


def tanh_value_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of the tanh form on ``[lower, upper]``."""
    return dipped(_tanh_value, TANH_LOWEST, lower, upper, ulps=ULPS, absolute=FLOOR)
