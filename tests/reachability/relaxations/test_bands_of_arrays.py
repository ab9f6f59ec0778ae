"""Bands of arrays are those of tensors, whatever the interval."""

import math

import numpy as np
import pytest
import torch

from sagemp_cli.reachability.relaxations import leaky_relu, reciprocal, sine
from sagemp_cli.reachability.relaxations.pieces import Curve, Piece, band

CUBE = Curve(
    lambda x: x * x * x,
    lambda x: 3.0 * (x * x),
    (
        Piece(-math.inf, 0.0, False, lambda slope, start, end: -(abs(slope / 3) ** 0.5)),
        Piece(0.0, math.inf, True, lambda slope, start, end: abs(slope / 3) ** 0.5),
    ),
    4,
)

BANDS = {
    "sin": sine.sine_band,
    "cos": sine.cosine_band,
    "leaky_relu": lambda lower, upper: leaky_relu.band(lower, upper, 0.1),
    "reciprocal": reciprocal.band,
    "a curve with an inflection": lambda lower, upper: band(CUBE, lower, upper),
}


def intervals() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    middle, exponent = torch.randn(2, 40, 5, dtype=torch.float64, generator=generator)
    radius = 10 ** (2 * exponent - 1)
    return middle - radius, middle + radius


@pytest.mark.parametrize("name", BANDS)
def test_an_array_has_the_band_of_the_tensor(name):
    lower, upper = intervals()
    of_tensors, of_arrays = BANDS[name](lower, upper), BANDS[name](lower.numpy(), upper.numpy())
    for ours, theirs in zip(of_arrays, of_tensors, strict=True):
        assert isinstance(ours, np.ndarray) and ours.shape == lower.shape
        np.testing.assert_allclose(ours, theirs.numpy(), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", BANDS)
def test_where_nothing_is_known_the_band_of_an_array_claims_nothing(name):
    ends = np.array([[0.5, -math.inf, 1.0, math.nan], [0.75, 1.0, math.inf, 1.0]])
    with np.errstate(all="ignore"):
        slope, offset, radius = BANDS[name](*ends)
    assert math.isfinite(radius[0])
    if name in ("reciprocal", "a curve with an inflection"):
        assert np.isinf(radius[1:]).all() and not slope[1:].any() and not offset[1:].any()
    assert name != "reciprocal" or np.isinf(BANDS[name](*np.array([[-0.1], [0.0]]))[2]).all()
