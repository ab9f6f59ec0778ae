"""The angle of a point, ``atan2(y, x)``, as an arc tangent of the smaller coordinate over the larger one.

Right of the diagonals ``atan(y / x)``, above and below them ``+-pi/2 - atan(x / y)``, left of them ``+-pi + atan(y /
x)``: which of these forms holds on a whole box is decided by its ends. A box that meets the negative x axis (where
the angle jumps) or the origin has no single form; its angle is anywhere in ``[-pi, pi]``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations.band import Band


class Quadrant(NamedTuple):
    """How to write the angle of each entry.

    Attributes:
        upright: where the quotient is x / y; else it is y / x.
        known: where there is a form at all.
        turned: what to do with the arc tangent of the quotient: multiply it by the slope and add the offset, up to
            the radius.
    """

    upright: Tensor
    known: Tensor
    turned: Band


def quadrant(y_lower: Tensor, y_upper: Tensor, x_lower: Tensor, x_upper: Tensor) -> Quadrant:
    """The form of each entry; of two that hold the one whose denominator is farther from 0."""
    zero = torch.zeros_like(y_lower)
    away_x = torch.maximum(x_lower, -x_upper)
    away_y = torch.maximum(y_lower, -y_upper)
    # x / y needs y of one sign; y / x needs x positive, or negative with y of one sign (then off the jump).
    sideways_holds = (x_lower > 0) | ((x_upper < 0) & (away_y > 0))
    upright_holds = away_y > 0
    upright = upright_holds & ((away_y >= away_x) | ~sideways_holds)
    known = upright | sideways_holds
    y_sign = torch.where(y_lower > 0, 1.0, -1.0).to(zero)
    offset = torch.where(upright, 0.5 * math.pi * y_sign, torch.where(x_upper < 0, math.pi * y_sign, zero))
    slope = torch.where(upright, -1.0, 1.0).to(zero)
    radius = torch.where(known, offset.abs() * 2.0**-52, zero + math.pi * (1.0 + 2.0**-50))
    return Quadrant(upright, known, Band(torch.where(known, slope, zero), torch.where(known, offset, zero), radius))


def value_range(y_lower: Tensor, y_upper: Tensor, x_lower: Tensor, x_upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds over a box: those at its corners, plus 8 ulps of pi; the whole circle if it meets the jump."""
    corners = torch.stack([torch.atan2(y, x) for y in (y_lower, y_upper) for x in (x_lower, x_upper)])
    known = ((x_lower > 0) | (y_lower > 0) | (y_upper < 0)) & torch.isfinite(corners).all(0)
    margin, whole = 8 * math.pi * 2.0**-52, math.pi * (1.0 + 2.0**-50)
    low, high = corners.amin(0) - margin, corners.amax(0) + margin
    return torch.where(known, low, torch.full_like(low, -whole)), torch.where(known, high, torch.full_like(high, whole))
