"""Ranges of powers end at 0 exactly where their operand does: there a root or a quotient begins."""

import math

import pytest
import torch

from sagemp_cli.reachability.relaxations.power import value_range


@pytest.mark.parametrize(
    ("lower", "upper", "exponent", "expected"),
    [
        (-2.0, 0.0, 3, (-8.0, 0.0)),
        (0.0, 2.0, 3, (0.0, 8.0)),
        (-1.0, 2.0, 3, (-1.0, 8.0)),
        (-2.0, 0.0, 2, (0.0, 4.0)),
        (0.0, 2.0, 2, (0.0, 4.0)),
        (-1.0, 2.0, 4, (0.0, 16.0)),
        (-2.0, -1.0, -1, (-1.0, -0.5)),
        (0.0, 2.0, -1, (0.0, math.inf)),
        (-2.0, 0.0, -2, (0.0, math.inf)),
    ],
)
def test_a_range_is_rounded_outwards_but_not_across_0(lower, upper, exponent, expected):
    low, high = (float(s) for s in value_range(*torch.tensor([lower, upper], dtype=torch.float64), exponent))
    assert low <= expected[0] and low == pytest.approx(expected[0], rel=1e-14, abs=0.0)
    assert high >= expected[1] and high == pytest.approx(expected[1], rel=1e-14, abs=0.0)
