import math

import numpy as np
import pytest
from flint import arb, ctx
from hypothesis import given, settings
from hypothesis import strategies as st

from sagemp_cli.checker.balls import Unproved
from sagemp_cli.checker.functions import (
    FUNCTIONS,
    SOFTPLUS,
    Smooth,
    clamp,
    elu,
    integer_power,
    leaky_relu,
    power,
    softplus,
)
from sagemp_cli.checker.jumps import JUMPS, fmod, remainder

NAMED = {
    **FUNCTIONS,
    "leaky_relu": leaky_relu(0.1),
    "clamp": clamp(-0.5, 1.5),
    "clamp from below": clamp(0.25, math.inf),
    "elu": elu(1.0),
    "elu with a small alpha": elu(0.3),
    "elu with a large alpha": elu(2.5),
    "smooth softplus": SOFTPLUS,
    "power 1.5": power(1.5),
    "power 0.3": power(0.3),
    "power -0.7": power(-0.7),
    "softplus": softplus(2.0, 20.0),
    "square": integer_power(2),
    "cube": integer_power(3),
    "inverse square": integer_power(-2),
}
JUMPING = {**JUMPS, "remainder": remainder(0.7), "fmod": fmod(0.7)}
POSITIVE = ("log", "sqrt", "reciprocal", "inverse square", "power 1.5", "power 0.3", "power -0.7")


@pytest.fixture(autouse=True)
def precision():
    with ctx.workprec(128):
        yield


@pytest.mark.parametrize("name", NAMED)
@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.floats(-6, 6), st.floats(-12, 3), st.floats(-2, 2))
def test_no_point_of_the_graph_lies_outside_and_both_bounds_are_nearly_met(name, middle, size, slope):
    function, width = NAMED[name], math.exp(size)
    if name in POSITIVE:
        middle = abs(middle) + 0.6 * width + 1e-3
    if name == "tan":
        middle, width = math.remainder(middle, math.pi) * 0.4, min(width, 0.5)
    with ctx.workprec(128):
        low, high, s = arb(middle - width / 2), arb(middle + width / 2), arb(slope)
        least, most = function.excess(s, low, high)
        values = []
        for x in np.linspace(float(low), float(high), 301):
            x = arb(float(x)).max(low).min(high)
            y = function.value(x) - s * x
            assert not (y < least) and not (y > most)
            values.append(float(y))
        coarse = 1e-9 + 1e-2 * (max(values) - min(values)) + 1e-3 * width
        assert float(least) >= min(values) - coarse and float(most) <= max(values) + coarse


@pytest.mark.parametrize("name", NAMED)
def test_derivatives_are_those_of_the_value(name):
    h = arb(2) ** -40
    pieces = [p for p in NAMED[name].pieces if isinstance(p[1], Smooth)]
    for begin, curve, end in pieces:
        for x in (-2.3, -1.4, -0.3, 0.4, 0.6, 1.7, 3.1):
            if (begin is not None and x <= begin) or (end is not None and x >= end) or (name in POSITIVE and x < 0):
                continue
            low, middle, high = (curve.value(arb(x) + side * h) for side in (-1, 0, 1))
            for found, wanted in (
                (curve.first, (high - low) / (2 * h)),
                (curve.second, (high - 2 * middle + low) / h**2),
            ):
                assert float(found(arb(x))) == pytest.approx(float(wanted), rel=1e-6, abs=1e-9), x


def test_the_bounds_of_sine_over_many_periods_are_those_of_its_extrema():
    least, most = FUNCTIONS["sin"].excess(arb(0), arb(-50), arb(60))
    assert abs(float(least) + 1) < 1e-12 and abs(float(most) - 1) < 1e-12


def test_a_straight_piece_with_its_own_slope_has_no_excess_at_all():
    least, most = leaky_relu(0.1).excess(arb(0.1), arb(-3.7), arb(-0.3))
    assert least == 0 and most == 0


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("reciprocal", -1.0, 2.0), ("log", -1.0, 1.0), ("tan", 1.0, 2.0), ("sqrt", -1.0, 4.0), ("inverse square", -1, 1)],
)
def test_an_interval_with_a_pole_is_not_bounded(name, low, high):
    with pytest.raises(Unproved):
        NAMED[name].excess(arb(0.5), arb(low), arb(high))


@pytest.mark.parametrize("bad", [arb("nan"), arb("inf"), arb(0, "inf")])
def test_nothing_follows_from_numbers_that_are_not_finite(bad):
    for arguments in ((bad, arb(0), arb(1)), (arb(0), bad, arb(1)), (arb(0), arb(0), bad)):
        with pytest.raises(Unproved, match="not finite"):
            FUNCTIONS["sin"].excess(*arguments)


@pytest.mark.parametrize("slope", [-1.0, 0.0, 0.4, 3.0])
def test_a_root_is_bounded_from_0_on(slope):
    least, most = FUNCTIONS["sqrt"].excess(arb(slope), arb(0), arb(2))
    x = np.linspace(0, 2, 100_001)
    values = np.sqrt(x) - slope * x
    assert float(least) <= values.min() + 1e-12 and values.max() <= float(most) <= values.max() + 1e-3


@pytest.mark.parametrize("name", JUMPING)
@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    st.sampled_from([0.0, 0.5, 1.0, -1.5, 2.25, 0.7, -0.7, 3.0]), st.floats(-12, 3), st.floats(-2, 2), st.integers(0, 2)
)
def test_no_point_of_a_function_that_jumps_lies_outside_and_the_hull_is_met(name, end, size, slope, side):
    function, width = JUMPING[name], math.exp(size)
    with ctx.workprec(128):
        low, high, s = arb(end - width * (side != 0)), arb(end + width * (side != 1)), arb(slope)
        least, most = function.excess(s, low, high)
        flat = function.excess(arb(0), low, high)
        values = []
        for x in [float(low), float(high), *np.linspace(float(low), float(high), 101), end]:
            x = arb(float(x)).max(low).min(high)
            y = function.value(x)
            assert not (y - s * x < least) and not (y - s * x > most)
            values.append(float(y.mid()))
        if name not in ("remainder", "fmod", "wrap"):  # of these the hull is of whole periods
            assert float(flat[0]) == min(values) and float(flat[1]) == max(values)


@pytest.mark.parametrize("name", JUMPING)
def test_where_nothing_jumps_a_function_is_a_line(name):
    """A slope of its own leaves a number."""
    slope = arb(1.0 if name in ("remainder", "fmod", "wrap") else 0.0)
    least, most = JUMPING[name].excess(slope, arb(7.1), arb(7.3))
    assert float(most - least) < 1e-30


def test_half_is_rounded_to_the_even_number():
    for x, rounded in ((0.5, 0), (1.5, 2), (2.5, 2), (-0.5, 0), (-1.5, -2)):
        assert JUMPS["round"].value(arb(x)) == rounded
