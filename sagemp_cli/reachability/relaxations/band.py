"""What a relaxation of a scalar function gives: a band around a line that contains its graph."""

from __future__ import annotations

import math
from typing import NamedTuple

from torch import Tensor

from sagemp_cli.reachability.relaxations.functions import all_finite, functions_of


class Band(NamedTuple):
    """``|f(x) - slope x - offset| <= radius`` for every real x of the interval, in real arithmetic.

    ``slope``, ``offset`` and ``radius >= 0`` are the exact float64 numbers stored; all rounding made in finding them
    is inside ``radius``. A band that claims nothing has an infinite radius, slope 0 and offset 0.
    """

    slope: Tensor
    offset: Tensor
    radius: Tensor


def settled(slope: Tensor, offset: Tensor, radius: Tensor) -> Band:
    """The band, which claims nothing where its radius came out as NaN or infinite.

    A relaxation's radius is not finite if the interval or anything computed from it is not, so the radius alone is
    asked: one sum in the usual case.
    """
    if all_finite(radius):
        return Band(slope, offset, radius)
    m = functions_of(radius)
    finite = m.isfinite(radius)
    return Band(m.where(finite, slope, 0.0), m.where(finite, offset, 0.0), m.where(finite, radius, math.inf))
