"""Trajectories as knots of splines."""

import pytest
import torch

from sagemp_cli.errors import ConfigError
from sagemp_cli.planners.spline import Spline


def rows(horizon=50, count=3, seed=0):
    """Cubics in time: what a spline can follow exactly."""
    s = torch.linspace(0, 1, horizon + 1, dtype=torch.float64)
    coefficients = torch.randn(count, 4, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return torch.stack([s**i for i in range(4)], dim=-1) @ coefficients


@pytest.mark.parametrize("knots", [4, 7, 20])
def test_cubics_come_back_from_their_knots(knots):
    spline, x = Spline(horizon=50, knots=knots), rows()
    assert spline.knots_of(x).shape == (3, knots, 2)
    assert torch.allclose(spline.rows_of(spline.knots_of(x)), x, atol=1e-11)


def test_knots_are_the_values_of_the_trajectory_at_their_times():
    x = rows()
    assert torch.allclose(Spline(horizon=50, knots=11).knots_of(x), x[:, ::5], atol=1e-11)


def test_row_0_is_kept_and_the_other_rows_are_fitted():
    noisy = rows() + 0.1 * torch.randn(3, 51, 2, generator=torch.Generator().manual_seed(1))
    spline = Spline(horizon=50, knots=12)
    knots = spline.knots_of(noisy)
    assert torch.equal(knots[:, 0], noisy[:, 0])
    best = (spline.rows_of(knots) - noisy).square().sum()
    for i in range(1, 12):
        moved = knots.clone()
        moved[:, i] += 1e-3
        assert (spline.rows_of(moved) - noisy).square().sum() > best
    assert (spline.rows_of(knots) - noisy).abs().amax((0, 1)).min() > 0.05


def test_as_many_knots_as_rows_lose_nothing():
    x = torch.randn(2, 21, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    spline = Spline(horizon=20, knots=21)
    assert torch.allclose(spline.rows_of(spline.knots_of(x)), x, atol=1e-12)


@pytest.mark.parametrize("knots", [3, 52])
def test_a_wrong_number_of_knots_is_named(knots):
    with pytest.raises(ConfigError, match=rf"knots must lie between 4 and horizon \+ 1 = 51, found {knots}"):
        Spline(horizon=50, knots=knots)
