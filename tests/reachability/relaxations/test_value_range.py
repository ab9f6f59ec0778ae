"""Bounds of values rounded outwards, also where there is no finite one."""

import math

import numpy as np
import pytest
import torch
from flint import arb, ctx

from sagemp_cli.reachability.relaxations import sine, softplus
from sagemp_cli.reachability.relaxations.value_range import outward

INF, NAN = math.inf, math.nan


def test_a_bound_that_is_not_finite_says_nothing_and_any_other_moves_outwards():
    least = torch.tensor([-INF, INF, NAN, -1.0], dtype=torch.float64)
    most = torch.tensor([-INF, INF, NAN, 1.0], dtype=torch.float64)
    low, high = outward(least, most, ulps=1)
    assert low[:3].tolist() == [-INF] * 3 and -1.001 < float(low[3]) < -1.0
    assert high[:3].tolist() == [INF] * 3 and 1.0 < float(high[3]) < 1.001


def test_the_least_of_a_softplus_far_below_0_is_0_and_no_small_number():
    low, high = softplus.value_range(*torch.tensor([[-800.0], [-700.0]], dtype=torch.float64), 2.0)
    assert low.item() == 0.0 < high.item() < 1e-200


@pytest.mark.parametrize("exponent", [3, 20, 29, 33, 36, 40])
def test_a_maximum_of_a_sine_just_inside_of_an_end_is_seen_however_far_away(exponent):
    """A turn is known the worse the farther from 0 it is: what rounding hides there must not be left out."""
    most = int(2.0**exponent / (2 * math.pi))
    turns = np.random.default_rng(0).integers(-most, most, 400)
    with ctx.workprec(200):
        for value_range, phase in ((sine.sine_range, arb.pi() / 2), (sine.cosine_range, arb(0))):
            tops = [phase + 2 * arb.pi() * int(k) for k in turns]
            near = np.array([float(top) for top in tops])
            inside = np.array([top <= arb(x) for top, x in zip(tops, near.tolist(), strict=True)])
            upper = np.where(inside, near, np.nextafter(near, INF))
            _, high = value_range(upper - 0.5, upper)
            assert (high >= 1.0).all()
