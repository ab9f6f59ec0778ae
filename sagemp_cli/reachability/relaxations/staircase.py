"""Functions that rise in steps: floor, ceil, round (half to even), trunc, sign, and 1 for what is positive, else 0.

Where a set meets no step the function is a number. Else a band is the hull of the values that it may take, a constant;
of a rounding function that takes more than two, the argument plus or minus what it may be rounded by.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations import lines as _lines
from sagemp_cli.reachability.relaxations.band import Band, settled
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.sets.rounding import TINY, slack


class Staircase(NamedTuple):
    """A function that never falls and takes whole numbers.

    Attributes:
        value: of numbers, exact.
        least, most: bounds of ``f(x) - x``; infinite for a function that does not round.
    """

    value: Callable[[Tensor], Tensor]
    least: float = -math.inf
    most: float = math.inf

    def band(self, lower: Tensor, upper: Tensor) -> Band:
        """The band around a number, or around the argument."""
        low, high = self.value(lower), self.value(upper)
        center, radius = 0.5 * (low + high), 0.5 * (high - low)
        slope = torch.zeros_like(center)
        if math.isfinite(self.most):
            many = radius > 0.5
            least, most = self.least * torch.ones_like(center), self.most * torch.ones_like(center)
            if self.least < -0.5 and self.most > 0.5:  # rounded towards 0
                least, most = torch.where(upper <= 0, 0.0, least), torch.where(lower >= 0, 0.0, most)
            slope = many.to(center)
            center = torch.where(many, 0.5 * (least + most), center)
            radius = torch.where(many, 0.5 * (most - least), radius)
        radius = radius + slack(low.abs() + high.abs(), 4) * (radius > 0) + 0.0 * (lower + upper)
        return settled(slope, center, radius)

    def lines(self, lower: Tensor, upper: Tensor) -> Lines:
        """The edges of the band."""
        slope, offset, radius = self.band(lower, upper)
        margin = radius + (slack(offset.abs() + radius, 4) + TINY) * (radius > 0)
        return _lines.settled(Lines(slope, offset - margin, slope, offset + margin))

    def value_range(self, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
        """The values at the ends, exact."""
        low = self.value(torch.nan_to_num(lower, nan=-math.inf, posinf=math.inf, neginf=-math.inf))
        return low, self.value(torch.nan_to_num(upper, nan=math.inf, posinf=math.inf, neginf=-math.inf))


FLOOR = Staircase(torch.floor, -1.0, 0.0)
CEIL = Staircase(torch.ceil, 0.0, 1.0)
ROUND = Staircase(torch.round, -0.5, 0.5)
TRUNC = Staircase(torch.trunc, -1.0, 1.0)
SIGN = Staircase(torch.sign)
POSITIVE = Staircase(lambda x: (x > 0).to(x))
