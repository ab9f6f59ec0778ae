"""What a relaxation of a scalar function gives: a band around a line that contains its graph."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

UNIT = 2.0**-53
"""Unit roundoff of float64: a correctly rounded operation errs by at most ``UNIT`` times its result."""

TINY = 1e-250
"""Absorbs underflow: far above every subnormal error, far below everything of interest."""


class Band(NamedTuple):
    """``|f(x) - slope x - offset| <= radius`` for every real x of the interval, in real arithmetic.

    ``slope``, ``offset`` and ``radius >= 0`` are the exact float64 numbers stored; all rounding made in finding them is inside ``radius``.
    """

    slope: Tensor
    offset: Tensor
    radius: Tensor
