"""Sound bounds of a function's values, rounded outwards: what the interval propagator uses."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations.functions import functions_of
from sagemp_cli.sets.rounding import TINY, gamma


def outward(least: Any, most: Any, *, ulps: float, floor: float = -math.inf, absolute: float = TINY) -> tuple[Any, Any]:
    """Computed extremes moved outwards by their error (``ulps`` of 2^-52, and what does not depend on their size, at
    least underflow); NaN becomes infinite.

    But not below the floor, a bound of all values: the domains of roots and quotients begin at 0 exactly. Of tensors or
    of arrays.
    """
    margin, m = gamma(2 * ulps + 1), functions_of(least)
    low = m.nan_to_num(least - (abs(least) * margin + absolute), nan=-math.inf, posinf=math.inf, neginf=-math.inf)
    high = m.nan_to_num(most + (abs(most) * margin + absolute), nan=math.inf, posinf=math.inf, neginf=-math.inf)
    return m.clamp(low, min=floor), high


def increasing(
    value: Callable[[Tensor], Tensor], lower: Tensor, upper: Tensor, **margins: float
) -> tuple[Tensor, Tensor]:
    """Range of an increasing function; margins as for :func:`outward`."""
    return outward(value(lower), value(upper), **margins)


def dipped(
    value: Callable[[Tensor], Tensor], lowest: float, lower: Tensor, upper: Tensor, **margins: float
) -> tuple[Tensor, Tensor]:
    """Range of a function that falls up to the point ``lowest`` and rises from there; margins as for :func:`outward`.

    The point may be off by rounding, which is of second order in the value.
    """
    first, last = value(lower), value(upper)
    inside = value(torch.minimum(lower.clamp(min=lowest), upper))
    return outward(torch.minimum(torch.minimum(first, last), inside), torch.maximum(first, last), **margins)
