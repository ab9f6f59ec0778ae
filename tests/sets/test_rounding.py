"""The named bounds of rounding hold on the worst sums and products that were found, and not by far too much."""

from fractions import Fraction
from itertools import accumulate

import numpy as np
import pytest

from sagemp_cli.sets.rounding import SAFETY, UNIT, at_least, dot, gamma, slack

HALF = 2.0**-53
"""Half an ulp of 1."""


def exactly(values):
    return sum(map(Fraction, values), Fraction(0))


def one_by_one(values):
    *_, total = accumulate(values)
    return float(total)


@pytest.mark.parametrize("count", [2, 10, 1000, 5000])
def test_a_sum_whose_every_addition_loses_half_an_ulp_is_still_made_an_upper_bound(count):
    # 1 + u rounds to 1 (to even): each of the magnitudes that come after the first is lost.
    values = [1.0] + [HALF] * count
    found, exact = one_by_one(values), exactly(values)
    assert found == 1.0 < exact
    assert Fraction(found) * Fraction(at_least(count + 1)) >= exact
    # Without the factor it is none, and half of what the factor adds would hardly do: the bound is not idle.
    assert Fraction(found) * (1 + (Fraction(at_least(count + 1)) - 1) / 4) < exact or count < 50


@pytest.mark.parametrize("count", [3, 50, 2000])
def test_a_scalar_product_errs_by_less_than_its_bound_and_by_a_good_part_of_it(count):
    # Terms that are just above half an ulp of the running sum are rounded up each time.
    values, running = [1.0], 1.0
    for _ in range(count - 1):
        term = float(np.nextafter(np.spacing(running) / 2, 1.0))
        values.append(term)
        running += term
    exact, size = exactly(values), exactly(map(abs, values))
    error = abs(Fraction(running) - exact)
    assert error <= Fraction(dot(count)) * size
    assert error > Fraction(dot(count)) * size / 4
    assert error > Fraction(dot(count // 4)) * size  # a bound of a quarter of the terms is noticed


@pytest.mark.parametrize("count", [1, 7, 300])
def test_products_of_roundings_stay_within_gamma_once_safety_is_applied(count):
    exact = (1 + Fraction(UNIT)) ** count - 1
    assert exact <= Fraction(gamma(count)) * Fraction(SAFETY)
    assert (1 / (1 - Fraction(UNIT))) ** count - 1 <= Fraction(gamma(count)) * Fraction(SAFETY)
    assert count == 1 or exact > Fraction(gamma(count))  # SAFETY is needed


def test_safety_serves_for_as_many_roundings_as_it_says():
    k = 9 * 10**6
    assert Fraction(gamma(k)) / (1 - k * Fraction(UNIT)) <= Fraction(gamma(k)) * Fraction(SAFETY)
    k *= 10
    assert Fraction(gamma(k)) / (1 - k * Fraction(UNIT)) > Fraction(gamma(k)) * Fraction(SAFETY)


def test_slack_is_what_that_many_roundings_of_a_size_lose():
    size, total = 3.0, 0.0
    for _ in range(8):
        total += float(np.spacing(size)) / 2
    assert slack(size, 8) * 2 >= total >= slack(size, 8) / 2
