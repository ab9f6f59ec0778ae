"""Leaky ReLU (and ReLU, slope 0): ``f(x) = max(x, s x)``, ``0 <= s < 1``."""

from __future__ import annotations

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations.band import TINY, UNIT, Band


def band(lower: Tensor, upper: Tensor, negative_slope: float, slope: Tensor | None = None) -> Band:
    """The band of smallest radius (slope of the chord), or the best one for a given slope in ``[s, 1]``.

    For every slope ``a`` in ``[s, 1]``: ``f(x) - a x`` lies between 0 (at the kink) and
    ``max((s - a) lower, (1 - a) upper)`` (at the ends), so the band is exact up to rounding, whatever ``a``.
    """
    low, high = lower.clamp(max=0.0), upper.clamp(min=0.0)
    if slope is None:
        chord = (high - negative_slope * low) / (high - low + TINY)
        slope = chord.clamp(negative_slope, 1.0)
        slope = torch.where(lower >= 0, torch.ones_like(slope), slope)
        slope = torch.where(upper <= 0, torch.full_like(slope, negative_slope), slope)
    gap = torch.maximum((negative_slope - slope) * low, (1.0 - slope) * high)
    # Two roundings in the gap and one in the half: 4 UNIT; an upper bound of the gap gives an upper bound of both halves.
    half = gap * (0.5 + 4 * UNIT)
    return Band(slope, half, half)


def value_range(lower: Tensor, upper: Tensor, negative_slope: float) -> tuple[Tensor, Tensor]:
    """Monotone: the values at the ends (the product is rounded outwards by the caller's margin)."""
    leaky = torch.nn.functional.leaky_relu
    return leaky(lower, negative_slope), leaky(upper, negative_slope)
