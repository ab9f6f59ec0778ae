"""Boxes over the parts of a step hold the whole line, rounding included, and are no larger than they must be."""

from __future__ import annotations

import math
from fractions import Fraction

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sagemp_cli.errors import UsageError
from sagemp_cli.sets import PARTS, Bulge, Tube, over_steps
from sagemp_cli.sets.between import at_fraction, exact_fraction, moment

NUMBERS = st.floats(-1e6, 1e6)


def tube_of(*rows):
    """One state; rows are (lower, upper)."""
    return Tube(*(torch.tensor([[row[i]] for row in rows], dtype=torch.float64) for i in (0, 1)))


@given(rows=st.lists(st.tuples(NUMBERS, NUMBERS).map(sorted), min_size=2, max_size=4), parts=st.sampled_from([1, 2, 8]))
def test_every_part_holds_the_exact_line_and_is_its_hull_but_for_rounding(rows, parts):
    boxes = over_steps(tube_of(*rows), parts=parts)
    assert boxes.lower.shape == (len(rows) - 1, parts, 1)
    for k, (first, last) in enumerate(zip(rows[:-1], rows[1:], strict=True)):
        for i in range(parts):
            low, high = float(boxes.lower[k, i, 0]), float(boxes.upper[k, i, 0])
            ends = [
                [(1 - s) * Fraction(a) + s * Fraction(b) for a, b in zip(first, last, strict=True)]
                for s in (Fraction(i, parts), Fraction(i + 1, parts))
            ]
            least, most = min(ends[0][0], ends[1][0]), max(ends[0][1], ends[1][1])
            assert Fraction(low) <= least and most <= Fraction(high)
            size = 1e-15 * (1e-300 + max(abs(v) for v in (*first, *last)))
            assert float(least - Fraction(low)) <= size and float(Fraction(high) - most) <= size


@given(first=NUMBERS, last=NUMBERS, curve=st.floats(0, 10), swing=st.floats(0, 10), rest=st.floats(0, 10))
def test_a_bulge_is_held_with_its_greatest_weight_in_each_part(first, last, curve, swing, rest):
    bulge = Bulge(*(torch.full((1, 1), v, dtype=torch.float64) for v in (curve, swing, rest)))
    boxes = over_steps(tube_of((first, first), (last, last)), bulge)
    for i in range(PARTS):
        for j in range(11):
            s = Fraction(10 * i + j, 10 * PARTS)
            line = (1 - s) * Fraction(first) + s * Fraction(last)
            reach = s * (1 - s) * (Fraction(curve) + Fraction(swing)) + Fraction(rest)
            assert Fraction(float(boxes.lower[0, i, 0])) <= line - reach
            assert line + reach <= Fraction(float(boxes.upper[0, i, 0]))
    middle = float(boxes.upper[0, PARTS // 2, 0])
    far = 0.25 * (curve + swing) + rest + max(0.5 * (first + last), first + (0.5 + 1 / PARTS) * (last - first))
    assert middle <= far + 1e-9 * (1 + abs(far) + abs(first) + abs(last))


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("side", ["lower", "upper"])
def test_what_is_not_finite_at_one_end_bounds_nothing_over_the_step(wrong, side):
    tube = Tube(torch.zeros(4, 2, dtype=torch.float64), torch.ones(4, 2, dtype=torch.float64))
    getattr(tube, side)[2, 0] = wrong
    boxes = over_steps(tube)
    endless = torch.isinf(boxes.lower) & torch.isinf(boxes.upper)
    assert endless[..., 0].all(-1).tolist() == [False, True, True] and not bool(endless[..., 1].any())
    assert not bool(torch.isnan(boxes.lower).any() | torch.isnan(boxes.upper).any())


@given(a=NUMBERS, b=NUMBERS, s=st.floats(0, 1))
def test_a_place_on_a_line_is_held_exactly(a, b, s):
    fraction = exact_fraction(torch.tensor([s], dtype=torch.float64))
    box = at_fraction(tube_of((a, a), (b, b)), fraction)
    exact = Fraction(float(fraction))
    place = (1 - exact) * Fraction(a) + exact * Fraction(b)
    assert Fraction(float(box.lower)) <= place <= Fraction(float(box.upper))
    assert Fraction(1 - float(fraction)) == 1 - exact
    if exact in (0, 1):
        assert float(box.lower) == float(box.upper) == (b if exact else a)


def test_a_number_of_parts_whose_ends_are_not_exact_is_refused():
    with pytest.raises(UsageError, match="power of two of parts, found 6"):
        over_steps(tube_of((0, 1), (0, 1)), parts=6)


def test_a_moment_is_named_in_steps_and_seconds():
    assert moment(3) == "step 3" and moment(3, 0.0, 0.1) == "step 3, 0.3 s"
    assert moment(6, 7 / 8) == "step 6.875" and moment(6, 7 / 8, 0.1) == "step 6.875, 0.6875 s"
