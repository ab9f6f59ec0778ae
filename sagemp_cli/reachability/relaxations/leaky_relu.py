"""Leaky ReLU ``f(x) = max(x, s x)`` with ``s <= 1``: ReLU for s = 0, the absolute value for s = -1."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations import lines as _lines
from sagemp_cli.reachability.relaxations.band import Band, settled
from sagemp_cli.reachability.relaxations.functions import functions_of
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.reachability.relaxations.value_range import outward
from sagemp_cli.sets.rounding import TINY, gamma


def band(lower: Tensor, upper: Tensor, negative_slope: float, slope: Tensor | None = None) -> Band:
    """The band of smallest radius (slope of the chord), or the best one for a given slope in ``[s, 1]``.

    For every slope ``a`` in ``[s, 1]``: ``f(x) - a x`` lies between 0 (at the kink) and
    ``max((s - a) lower, (1 - a) upper)`` (at the ends), so the band is exact up to rounding, whatever ``a``.
    """
    slope, gap = _chord_and_gap(lower, upper, negative_slope, slope)
    # Two roundings in the gap and one in the half; an upper bound of the gap gives an upper bound of both
    # halves.

    half = gap * (0.5 + gamma(4))
    return settled(slope, half, half)


def lines(lower: Tensor, upper: Tensor, negative_slope: float) -> Lines:
    """Above the chord; below the one of the two rays ``x`` and ``s x`` on whose side more of the interval lies."""
    slope, gap = _chord_and_gap(lower, upper, negative_slope, None)
    one = torch.ones_like(slope)
    below = torch.where(upper >= -lower, one, negative_slope * one)
    below = torch.where((lower >= 0) | (upper <= 0), slope, below)
    return _lines.settled(Lines(below, torch.zeros_like(slope), slope, gap * (1.0 + gamma(4))))


def value_range(lower: Tensor, upper: Tensor, negative_slope: float) -> tuple[Tensor, Tensor]:
    """Bounds on ``[lower, upper]``: monotone for ``s >= 0``; V-shaped for ``s < 0``, least at the kink."""
    m = functions_of(lower)
    first, last = m.maximum(lower, negative_slope * lower), m.maximum(upper, negative_slope * upper)
    if negative_slope >= 0:
        low, high = outward(first, last, ulps=1, floor=-math.inf if negative_slope else 0.0)
        return m.where(lower >= 0, lower, low), high
    least = m.where((lower <= 0) & (upper >= 0), 0.0, m.minimum(first, last))
    return outward(least, m.maximum(first, last), ulps=1, floor=0.0)


def _chord_and_gap(lower: Tensor, upper: Tensor, negative_slope: float, slope: Tensor | None) -> tuple[Tensor, Tensor]:
    """The chord's slope (if none is given) and the largest ``f(x) - slope x``.

    Ends on the far side of the kink are moved to the kink, or just past it: then no product below can underflow and
    no quotient is 0/0.
    """
    m = functions_of(lower)
    low, high = m.clamp(lower, max=-TINY), m.clamp(upper, min=TINY)
    if slope is None:
        slope = m.clamp((high - negative_slope * low) / (high - low), negative_slope, 1.0)
        slope = m.where(lower >= 0, 1.0, m.where(upper <= 0, negative_slope, slope))
    assert slope is not None
    return slope, m.maximum((negative_slope - slope) * low, (1.0 - slope) * high)
