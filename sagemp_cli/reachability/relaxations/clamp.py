"""Clamp to limits, ``min(max(x, lo), hi)``: saturated inputs, hard tanh, ReLU6. Either limit may be missing (infinite).

Flat, rising, flat: with slope ``a`` the excess is extreme at the ends or at the kinks, so four points decide. The
band's best slope is the smaller of two: from the left end to the upper kink (or the right end), and from the lower kink
(or the left end) to the right end. Lower than both, the radius falls with the slope, because the extremes are the two
kinks; higher than either, it rises.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations import lines as _lines
from sagemp_cli.reachability.relaxations.band import Band, settled
from sagemp_cli.reachability.relaxations.functions import functions_of
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.sets.rounding import TINY, slack


def band(lower: Tensor, upper: Tensor, minimum: float | Tensor, maximum: float | Tensor) -> Band:
    """The band of smallest radius on ``[lower, upper]``; as in torch, maximum wins where it is below minimum."""
    points, values = _corners(lower, upper, minimum, maximum)
    rise_left, rise_right = _slopes(points, values)
    slope = torch.minimum(rise_left, rise_right)
    least, most = _extremes(slope, points, values)
    radius = 0.5 * (most - least) + slack(most.abs() + least.abs(), 2) + 0.0 * (lower + upper)
    return settled(slope, 0.5 * (most + least), radius)


def lines(lower: Tensor, upper: Tensor, minimum: float | Tensor, maximum: float | Tensor) -> Lines:
    """The segments of the concave and of the convex hull above and below the interval's middle."""
    points, values = _corners(lower, upper, minimum, maximum)
    rise_left, rise_right = _slopes(points, values)
    middle = 0.5 * lower + 0.5 * upper
    flat = torch.zeros_like(rise_left)
    above = torch.where(middle <= points[2], rise_left, flat)
    below = torch.where(middle >= points[1], rise_right, flat)
    most, least = _extremes(above, points, values)[1], _extremes(below, points, values)[0]
    return _lines.settled(Lines(below, least, above, most + 0.0 * (lower + upper)))


def value_range(lower: Any, upper: Any, minimum: float | Tensor, maximum: float | Tensor) -> tuple[Any, Any]:
    """Bounds on ``[lower, upper]``, exact; of an unknown argument the limits; of tensors or of arrays."""
    m = functions_of(lower)
    if m is not torch:
        low, high = (limit.numpy() if isinstance(limit, Tensor) else limit for limit in (minimum, maximum))
        unknown = np.isnan(lower) | np.isnan(upper)
        lower, upper = np.where(unknown, -np.inf, lower), np.where(unknown, np.inf, upper)
        return np.minimum(np.maximum(lower, low), high), np.minimum(np.maximum(upper, low), high)
    lower = torch.nan_to_num(lower, nan=-torch.inf, posinf=torch.inf, neginf=-torch.inf)
    upper = torch.nan_to_num(upper, nan=torch.inf, posinf=torch.inf, neginf=-torch.inf)
    return _clamp(lower, minimum, maximum), _clamp(upper, minimum, maximum)


def _clamp(x: Tensor, minimum: float | Tensor, maximum: float | Tensor) -> Tensor:
    return x.clamp(min=minimum).clamp(max=maximum)


def _corners(lower: Tensor, upper: Tensor, minimum: float | Tensor, maximum: float | Tensor) -> tuple[Tensor, Tensor]:
    """Left end, lower kink, upper kink, right end (kinks moved into the interval), and the values there; exact."""
    left, right = (torch.minimum(lower.clamp(min=limit), upper) for limit in (minimum, maximum))
    points = torch.stack(torch.broadcast_tensors(lower, left, right, upper))
    return points, _clamp(points, minimum, maximum)


def _slopes(points: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """Slopes left end to upper kink and lower kink to right end, in [0, 1]."""
    run = torch.stack([points[2] - points[0], points[3] - points[1]])
    rise = torch.stack([values[2] - values[0], values[3] - values[1]])
    slopes = torch.where(rise == run, torch.ones_like(run), rise / (run + TINY)).clamp(0.0, 1.0)
    slopes = torch.where(run == 0, torch.zeros_like(run), slopes)
    return slopes[0], slopes[1]


def _extremes(slope: Tensor, points: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of the excess, rounding included."""
    tilted = slope * points
    excess = values - tilted
    margin = slack(values.abs() + tilted.abs(), 4) + TINY
    return (excess - margin).amin(0), (excess + margin).amax(0)
