"""Logistic function, as ``sigmoid(x) = (1 + tanh(x / 2)) / 2``; halving is exact, so tanh's margins serve."""

from __future__ import annotations

from torch import Tensor

from sagemp_cli.reachability.relaxations import tanh
from sagemp_cli.reachability.relaxations.band import Band, settled
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.sets.rounding import UNIT


def band(lower: Tensor, upper: Tensor) -> Band:
    """Band of the logistic function on ``[lower, upper]``."""
    slope, offset, radius = tanh.band(0.5 * lower, 0.5 * upper)
    return settled(0.25 * slope, 0.5 + 0.5 * offset, 0.5 * radius + (1.0 + offset.abs()) * UNIT)


def lines(lower: Tensor, upper: Tensor) -> Lines:
    """Lines of the logistic function on ``[lower, upper]``."""
    a, low, b, high = tanh.lines(0.5 * lower, 0.5 * upper)
    return Lines(
        0.25 * a,
        0.5 + 0.5 * low - (1.0 + low.abs()) * (2 * UNIT),
        0.25 * b,
        0.5 + 0.5 * high + (1.0 + high.abs()) * (2 * UNIT),
    )


def value_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of the logistic function on ``[lower, upper]``."""
    low, high = tanh.value_range(0.5 * lower, 0.5 * upper)
    return ((0.5 + 0.5 * low) - 2 * UNIT).clamp(min=0.0), ((0.5 + 0.5 * high) + 2 * UNIT)
