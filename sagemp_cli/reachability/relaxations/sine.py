"""Sine and cosine, on intervals of any width.

With slope ``a`` the excess ``e(x) = sin x - a x`` has its local maxima at ``t + 2 pi k`` and its local minima at
``-t + 2 pi k`` with ``t = acos a``. Their values are linear in ``k``, so of all the extrema inside an interval only
the first and the last can decide, and the band is exact up to rounding on intervals of any width.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations.band import UNIT, Band

ULPS = 4
"""Margin, in ulps of 1, allowed to ``torch.sin``, ``torch.cos``, ``torch.acos`` in float64; tested against ball arithmetic."""

_SLACK = 1e-7  # an extremum this far outside (in turns) is counted too: its excess exceeds the end's by at most (2 pi slack)^2 / 2
_TWO_PI = 2.0 * math.pi


def sine_band(lower: Tensor, upper: Tensor) -> Band:
    """Band of ``sin`` on ``[lower, upper]``."""
    slope = _chord(torch.sin, torch.cos, lower, upper)
    crest = torch.acos(slope)
    return _band(torch.sin, slope, crest, -crest, lower, upper)


def cosine_band(lower: Tensor, upper: Tensor) -> Band:
    """Band of ``cos`` on ``[lower, upper]``."""
    slope = _chord(torch.cos, lambda x: -torch.sin(x), lower, upper)
    turn = torch.asin(slope)
    return _band(torch.cos, slope, -turn, math.pi + turn, lower, upper)


def _chord(f, df, lower: Tensor, upper: Tensor) -> Tensor:
    """Slope of the chord where the interval is wide enough to have one, of the tangent where not; within [-1, 1]."""
    width = upper - lower
    wide = width > 1e-6
    chord = (f(upper) - f(lower)) / torch.where(wide, width, torch.ones_like(width))
    return torch.where(wide, chord, df(0.5 * lower + 0.5 * upper)).clamp(-1.0, 1.0)


def _band(f, slope: Tensor, crest: Tensor, trough: Tensor, lower: Tensor, upper: Tensor) -> Band:
    """Band with a given slope whose excess has its maxima at ``crest`` and its minima at ``trough`` (plus 2 pi k)."""
    at_lower, at_upper = f(lower) - slope * lower, f(upper) - slope * upper
    height = torch.sqrt((1.0 - slope) * (1.0 + slope))
    most = _extreme(crest, height, slope, lower, upper, torch.maximum(at_lower, at_upper), torch.maximum)
    least = _extreme(trough, -height, slope, lower, upper, torch.minimum(at_lower, at_upper), torch.minimum)
    # Values err by ULPS ulps of 1 (sine), by 4 roundings of slope * x, and by the argument of the extrema (a few ulps
    # of x, times |slope| <= 1; the excess is flat there). The offset's rounding is in the margin as well.
    margin = (16 + 4 * ULPS) * UNIT * (8.0 + torch.maximum(lower.abs(), upper.abs()))
    return Band(slope, 0.5 * (most + least), 0.5 * (most - least) + margin)


def _extreme(base: Tensor, height: Tensor, slope: Tensor, lower: Tensor, upper: Tensor, ends: Tensor, pick) -> Tensor:
    """The extreme of the excess over the ends and the extrema ``base + 2 pi k`` inside the interval."""
    first = torch.ceil((lower - base) / _TWO_PI - _SLACK)
    last = torch.floor((upper - base) / _TWO_PI + _SLACK)
    values = pick(
        height - slope * (base + _TWO_PI * first),
        height - slope * (base + _TWO_PI * last),
    )
    return torch.where(first <= last, pick(ends, values), ends)
