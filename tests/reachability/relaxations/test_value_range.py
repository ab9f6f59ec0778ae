"""Bounds of values rounded outwards, also where there is no finite one."""

import math

import torch

from sagemp_cli.reachability.relaxations import softplus
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
