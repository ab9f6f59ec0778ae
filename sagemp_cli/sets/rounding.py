"""Rounding outwards, and the two numbers that every account of rounding is made of."""

from __future__ import annotations

import math

import torch
from torch import Tensor

UNIT = 2.0**-53
"""Unit roundoff of float64: a correctly rounded operation errs by at most ``UNIT`` times its result."""

TINY = 1e-250
"""Absorbs underflow: far above every subnormal error, far below everything of interest."""


def round_down(value: Tensor) -> Tensor:
    """The next float64 below each entry (infinities stay)."""
    return torch.nextafter(value, torch.full_like(value, -math.inf))


def round_up(value: Tensor) -> Tensor:
    """The next float64 above each entry (infinities stay)."""
    return torch.nextafter(value, torch.full_like(value, math.inf))
