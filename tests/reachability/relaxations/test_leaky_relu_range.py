"""A leaky ReLU: its range also where its negative slope is negative too, and its band where rounding matters."""

from fractions import Fraction

import pytest
import torch

from sagemp_cli.reachability.relaxations.leaky_relu import band, value_range


@pytest.mark.parametrize("slope", [-2.0, -1.0, -0.1, 0.0, 0.1, 1.0])
def test_the_range_holds_every_value(slope):
    generator = torch.Generator().manual_seed(0)
    ends = torch.randn(2, 500, dtype=torch.float64, generator=generator).sort(0).values
    low, high = value_range(ends[0], ends[1], slope)
    share = torch.linspace(0, 1, 101, dtype=torch.float64)[:, None]
    inside = (ends[0] + share * (ends[1] - ends[0])).clamp(ends[0], ends[1])
    points = torch.cat([inside, torch.zeros_like(ends[:1]).clamp(ends[0], ends[1])])
    values = torch.nn.functional.leaky_relu(points, slope)
    assert bool((low <= values.amin(0)).all()) and bool((values.amax(0) <= high).all())
    assert bool((high - values.amax(0) < 1e-12).all()) and bool((values.amin(0) - low < 1e-12).all())


@pytest.mark.parametrize("slope", [0.0, 0.1, 1.0])
def test_what_is_not_negative_stays_so_exactly(slope):
    lower, upper = torch.tensor([0.0, 0.1, 2.0]).double(), torch.tensor([0.0, 1.0, 3.0]).double()
    assert torch.equal(value_range(lower, upper, slope)[0], lower)


@pytest.mark.parametrize("slope", [0.1, 0.3, 0.7])
@pytest.mark.parametrize(("low", "high"), [(-3e16, 0.7), (-0.7, 3e16), (-1e8, 1.1), (-1.1, 1e8), (-0.3, 0.7)])
def test_a_band_holds_the_ends_and_the_kink_exactly_however_lopsided_it_is(slope, low, high):
    found = band(torch.tensor([low], dtype=torch.float64), torch.tensor([high], dtype=torch.float64), slope)
    tilt, offset, radius = (Fraction(float(part)) for part in found)
    for x in (Fraction(low), Fraction(0), Fraction(high)):
        value = x if x > 0 else Fraction(slope) * x
        assert abs(value - tilt * x - offset) <= radius
