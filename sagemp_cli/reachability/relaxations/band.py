"""What a relaxation of a scalar function gives: a band around a line that contains its graph."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

UNIT = 2.0**-53
"""Unit roundoff of float64: a correctly rounded operation errs by at most ``UNIT`` times its result."""

TINY = 1e-250
"""Absorbs underflow: far above every subnormal error, far below everything of interest."""


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
    if math.isfinite(radius.detach().sum().item()):
        return Band(slope, offset, radius)
    finite = torch.isfinite(radius)
    zero = torch.zeros_like(radius)
    return Band(
        torch.where(finite, slope, zero),
        torch.where(finite, offset, zero),
        torch.where(finite, radius, torch.full_like(radius, math.inf)),
    )
