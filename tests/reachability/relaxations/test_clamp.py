"""A clamp among the smallest numbers there are, where halves round to nothing."""

from fractions import Fraction

import pytest
import torch

from sagemp_cli.reachability.relaxations.clamp import band, lines

LEAST = 2.0**-1074


@pytest.mark.parametrize("limit", [1, 2, 3, 5])
def test_bands_and_lines_hold_where_everything_underflows(limit):
    lower, upper = torch.zeros(1, dtype=torch.float64), torch.full((1,), 7 * LEAST, dtype=torch.float64)
    most = torch.full((1,), limit * LEAST, dtype=torch.float64)
    slope, offset, radius = (Fraction(float(part)) for part in band(lower, upper, -most, most))
    below, least, above, highest = (Fraction(float(part)) for part in lines(lower, upper, -most, most))
    for times in range(8):
        x, value = times * Fraction(LEAST), min(times, limit) * Fraction(LEAST)
        assert abs(value - slope * x - offset) <= radius
        assert below * x + least <= value <= above * x + highest
