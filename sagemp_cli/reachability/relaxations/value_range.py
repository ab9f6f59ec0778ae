"""Sound bounds of a function's values, rounded outwards: what the interval propagator uses."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from sagemp_cli.sets.rounding import TINY, UNIT


def outward(least: Tensor, most: Tensor, *, ulps: float) -> tuple[Tensor, Tensor]:
    """Computed extremes moved outwards by their error (``ulps`` of 2^-52) and underflow; NaN becomes infinite."""
    margin = (2 * ulps + 1) * UNIT
    return (
        torch.nan_to_num(least - (least.abs() * margin + TINY), nan=-math.inf, posinf=math.inf, neginf=-math.inf),
        torch.nan_to_num(most + (most.abs() * margin + TINY), nan=math.inf, posinf=math.inf, neginf=-math.inf),
    )


def increasing(
    value: Callable[[Tensor], Tensor], lower: Tensor, upper: Tensor, *, ulps: float
) -> tuple[Tensor, Tensor]:
    """Range of an increasing function."""
    return outward(value(lower), value(upper), ulps=ulps)
