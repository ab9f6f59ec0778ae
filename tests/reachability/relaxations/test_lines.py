"""Lines that are the edges of a band lie outside of it, rounding included."""

from fractions import Fraction

import pytest
import torch

from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.lines import parallel


@pytest.mark.parametrize(("offset", "radius"), [(0.1, 1e-3), (1.0, 2.0**-54), (-1e9, 0.3), (0.7, 0.0)])
def test_the_edges_of_a_band_are_rounded_outwards(offset, radius):
    lines = parallel(Band(*torch.tensor([0.3, offset, radius], dtype=torch.float64)))
    assert Fraction(float(lines.lower_offset)) <= Fraction(offset) - Fraction(radius)
    assert Fraction(offset) + Fraction(radius) <= Fraction(float(lines.upper_offset))
    assert float(lines.lower_slope) == float(lines.upper_slope) == 0.3
    assert float(lines.upper_offset - lines.lower_offset) <= 2 * radius + 1e-14 * abs(offset)
