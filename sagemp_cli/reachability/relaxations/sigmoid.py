"""Logistic function, as ``sigmoid(x) = (1 + tanh(x / 2)) / 2``; halving is exact, so tanh's margins serve."""

from __future__ import annotations

from torch import Tensor

from sagemp_cli.reachability.relaxations import tanh
from sagemp_cli.reachability.relaxations.band import Band, settled
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.sets.rounding import gamma, slack


def band(lower: Tensor, upper: Tensor) -> Band:
    """Band of the logistic function on ``[lower, upper]``."""
    slope, offset, radius = tanh.band(0.5 * lower, 0.5 * upper)
    return settled(0.25 * slope, 0.5 + 0.5 * offset, 0.5 * radius + slack(1.0 + offset.abs(), 1))


def lines(lower: Tensor, upper: Tensor) -> Lines:
    """Lines of the logistic function on ``[lower, upper]``."""
    a, low, b, high = tanh.lines(0.5 * lower, 0.5 * upper)
    return Lines(
        0.25 * a,
        0.5 + 0.5 * low - slack(1.0 + low.abs(), 2),
        0.25 * b,
        0.5 + 0.5 * high + slack(1.0 + high.abs(), 2),
    )


def value_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of the logistic function on ``[lower, upper]``."""
    low, high = tanh.value_range(0.5 * lower, 0.5 * upper)
    return ((0.5 + 0.5 * low) - gamma(2)).clamp(min=0.0), ((0.5 + 0.5 * high) + gamma(2))
