"""What backward bound propagation (CROWN) asks of a relaxation: one line below the graph and one above it."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.sets.rounding import slack


class Lines(NamedTuple):
    """``lower_slope x + lower_offset <= f(x) <= upper_slope x + upper_offset`` for every real x of the interval.

    Four exact float64 numbers per entry, in real arithmetic; the rounding made in finding them is inside the offsets.
    Lines that claim nothing have slope 0 and infinite offsets.
    """

    lower_slope: Tensor
    lower_offset: Tensor
    upper_slope: Tensor
    upper_offset: Tensor


def parallel(band: Band) -> Lines:
    """The two edges of a band: lines for any function that has a band."""
    slope, offset, radius = band
    margin = radius + slack(offset.abs() + radius, 4)
    return Lines(slope, offset - margin, slope, offset + margin)


def settled(lines: Lines) -> Lines:
    """The lines, which claim nothing where one of the four numbers is not finite."""
    if math.isfinite(sum(part.detach().sum().item() for part in lines)):
        return lines
    finite = torch.isfinite(lines[0]) & torch.isfinite(lines[1]) & torch.isfinite(lines[2]) & torch.isfinite(lines[3])
    return Lines(
        *(
            torch.where(finite, part, torch.full_like(part, fill))
            for part, fill in zip(lines, (0.0, -math.inf, 0.0, math.inf), strict=True)
        )
    )


def choose(first: Lines, second: Lines, middle: Tensor) -> Lines:
    """Of two pairs of lines the better one on each side: closer to the graph at the middle, so of smaller area."""
    below = second.lower_slope * middle + second.lower_offset > first.lower_slope * middle + first.lower_offset
    above = second.upper_slope * middle + second.upper_offset < first.upper_slope * middle + first.upper_offset
    return Lines(
        torch.where(below, second.lower_slope, first.lower_slope),
        torch.where(below, second.lower_offset, first.lower_offset),
        torch.where(above, second.upper_slope, first.upper_slope),
        torch.where(above, second.upper_offset, first.upper_offset),
    )
