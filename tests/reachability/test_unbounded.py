"""A set that reaches the end of a function's domain: bounds where there are any, else a tube without, and why."""

import math

import pytest
import torch

from sagemp_cli.reachability import reach
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.observed import observed
from sagemp_cli.reachability.unbounded import why_unbounded
from sagemp_cli.sets import Box

PROPAGATORS = ["interval", "affine", "crown", "best"]


def box(low, high):
    return Box(torch.tensor(low, dtype=torch.float64), torch.tensor(high, dtype=torch.float64))


@pytest.mark.parametrize("propagator", PROPAGATORS)
@pytest.mark.parametrize("call", [torch.sqrt, lambda x: x**1.5, lambda x: x**0.3, lambda x: x * torch.sqrt(x)])
def test_roots_and_powers_are_bounded_from_0_on(call, propagator):
    tube = reach(lambda x, w: call(x), box([0.0, 0.25], [4.0, 4.0]), horizon=3, propagator=propagator)
    assert bool(torch.isfinite(tube.width).all())
    first, last = call(torch.tensor([0.0, 0.25]).double()), call(torch.tensor([4.0, 4.0]).double())
    torch.testing.assert_close(tube.lower[1], first, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(tube.upper[1], last, rtol=1e-12, atol=1e-12)


UNBOUNDED = {
    "a logarithm of a value in [0, 1], where it is not bounded": (torch.log, [0.0], [1.0]),
    "a logarithm of a value in [-0.001, 1], where it is not bounded": (torch.log, [-0.001], [1.0]),
    "a root of a value in [-0.1, 1], where it is not bounded": (torch.sqrt, [-0.1], [1.0]),
    "a power 1.3 of a value in [-0.1, 1], where it is not bounded": (lambda x: x**1.3, [-0.1], [1.0]),
    "a power -2 of a value in [0, 1], where it is not bounded": (lambda x: x**-2, [0.0], [1.0]),
    "a quotient by a value in [0, 2], which holds 0": (lambda x: 1 / x, [0.0], [2.0]),
    "a quotient by a value in [-1, 1.5], which holds 0": (lambda x: x / (x - 0.5), [-0.5], [2.0]),
    "a tangent of a value in [1, 2], which has a pole": (torch.tan, [1.0], [2.0]),
    "'exp' of a value in [600, 709.79] overflows": (torch.exp, [600.0], [709.79]),
    "the logarithm times its argument": (lambda x: x * torch.log(x), [0.0], [1.0]),
}


@pytest.mark.parametrize("why", UNBOUNDED)
def test_where_a_function_ends_a_tube_has_no_bounds_and_says_why(why):
    call, low, high = UNBOUNDED[why]
    tube = reach(lambda x, w: call(x), box(low, high), horizon=2)
    assert bool(torch.isfinite(tube.width[0]).all()) and bool(torch.isinf(tube.width[1]).any())
    seen = observed(lambda x, w: call(x), box(low, high), None, 2)
    found = Affine().reach(seen.loop, Box(seen.start.lower[None], seen.start.upper[None]), seen.disturbance)
    said = why_unbounded(seen.loop, found.tube, seen.disturbance)
    assert said == (why if not why.startswith("the") else next(iter(UNBOUNDED)))


def test_a_step_that_is_no_number_somewhere_is_not_called_random():
    """At a corner of the start box it gives NaN, twice."""
    tube = reach(lambda x, w: torch.sqrt(x), box([-1e-9, 1.0], [1.0, 2.0]), horizon=1)
    assert math.isinf(float(tube.upper[1, 0])) and math.isfinite(float(tube.upper[1, 1]))


def test_a_bounded_tube_has_no_reason():
    seen = observed(lambda x, w: 0.5 * x, box([0.0], [1.0]), None, 3)
    found = Affine().reach(seen.loop, Box(seen.start.lower[None], seen.start.upper[None]), seen.disturbance)
    assert why_unbounded(seen.loop, found.tube, seen.disturbance) == ""


def test_a_tube_that_grows_without_end_is_an_overflow():
    seen = observed(lambda x, w: x * x, box([2.0], [3.0]), None, 12)
    found = Affine().reach(seen.loop, Box(seen.start.lower[None], seen.start.upper[None]), seen.disturbance)
    assert "overflow" in why_unbounded(seen.loop, found.tube, seen.disturbance)
