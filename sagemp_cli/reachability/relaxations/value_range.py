"""Sound bounds of a function's values, rounded outwards: what the interval propagator uses."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from sagemp_cli.sets.rounding import TINY, gamma


def outward(least: Tensor, most: Tensor, *, ulps: float, floor: float = -math.inf) -> tuple[Tensor, Tensor]:
    """Computed extremes moved outwards by their error (``ulps`` of 2^-52) and underflow; NaN becomes infinite.

    But not below the floor, a bound of all values: the domains of roots and quotients begin at 0 exactly.
    """
    margin = gamma(2 * ulps + 1)
    low = torch.nan_to_num(least - (least.abs() * margin + TINY), nan=-math.inf, posinf=math.inf, neginf=-math.inf)
    high = torch.nan_to_num(most + (most.abs() * margin + TINY), nan=math.inf, posinf=math.inf, neginf=-math.inf)
    return low.clamp(min=floor), high


def increasing(
    value: Callable[[Tensor], Tensor], lower: Tensor, upper: Tensor, **margins: float
) -> tuple[Tensor, Tensor]:
    """Range of an increasing function; margins as for :func:`outward`."""
    return outward(value(lower), value(upper), **margins)
