"""Constants that meet only constants inside one operation are taken exactly, or the operation is refused."""

from __future__ import annotations

from fractions import Fraction

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given, settings

from sagemp_cli.errors import UnsupportedOperationError
from sagemp_cli.reachability import reach
from sagemp_cli.reachability.program.constants import exact_parts
from sagemp_cli.sets import Box

NONE = Box.around([0.0], [0.0])
C32, D32 = torch.tensor([0.1]), torch.tensor([0.3])
C64 = torch.tensor([0.7], dtype=torch.float64)
numbers = st.floats(allow_nan=False, allow_infinity=False, min_value=-1e60, max_value=1e60).filter(
    lambda v: v == 0 or abs(v) > 1e-60
)


@settings(max_examples=200, deadline=None)
@given(numbers, numbers, numbers)
def test_the_parts_of_a_product_add_up_to_it_exactly(a, b, c):
    parts = exact_parts("addcmul", lambda *f: f[0] * f[1] * f[2], a, b, torch.tensor([c], dtype=torch.float64))
    assert sum(Fraction(p.item()) for p in parts) == Fraction(a) * Fraction(b) * Fraction(c)


def test_what_no_few_numbers_hold_is_refused():
    for function, constants in ((lambda n, d: n / d, (1.0, 3.0)), (lambda a, b: a * b, (1e-200, 1e-200))):
        with pytest.raises(UnsupportedOperationError, match="cannot be held exactly; compute it before"):
            exact_parts("addcdiv", function, *constants)
    with pytest.raises(UnsupportedOperationError, match="cannot be held exactly"):
        exact_parts("addcmul", lambda a, b: a * b, 1e200, 1e200)


def of(value) -> Fraction:
    return Fraction(float(value))


AT_100 = {
    "add alpha": (lambda x: torch.add(x, torch.tensor([3]), alpha=0.1), 100 + 3 * of(0.1)),
    "sub alpha": (lambda x: torch.sub(x, C32, alpha=0.7), 100 - of(0.7) * of(C32)),
    "rsub alpha": (lambda x: torch.rsub(x, C32, alpha=0.7), of(C32) - of(0.7) * 100),
    "rsub alpha of a constant": (lambda x: torch.rsub(C32, x, alpha=0.7), 100 - of(0.7) * of(C32)),
    "addcmul": (lambda x: torch.addcmul(x, C32, D32), 100 + of(C32) * of(D32)),
    "addcmul value": (lambda x: torch.addcmul(x, C32, D32, value=0.1), 100 + of(0.1) * of(C32) * of(D32)),
    "addcdiv": (lambda x: torch.addcdiv(x, C32, torch.tensor([4.0])), 100 + of(C32) / 4),
    "lerp": (lambda x: torch.lerp(C64, torch.tensor([1e-9], dtype=torch.float64), x), None),
    "addmm": (
        lambda x: torch.addmm(C32[None], x[None], D32[None], beta=0.7, alpha=0.1)[0],
        of(0.7) * of(C32) + of(0.1) * 100 * of(D32),
    ),
}


@pytest.mark.parametrize("name", AT_100)
def test_one_operation_is_that_of_real_arithmetic(name):
    function, expected = AT_100[name]
    expected = of(C64) + 100 * (Fraction(1e-9) - of(C64)) if expected is None else expected
    tube = reach(lambda x, w: function(x), Box.around([100.0], [0.0]), NONE, 1, batched=False)
    assert Fraction(tube.lower[1].item()) <= expected <= Fraction(tube.upper[1].item())
    assert tube.width[1].item() < 1e-11


def test_a_hypotenuse_with_a_float32_leg_is_that_of_real_arithmetic():
    tube = reach(lambda x, w: torch.hypot(x, C32), Box.around([1.0], [0.0]), NONE, 1, batched=False)
    square = 1 + of(C32) ** 2
    assert Fraction(tube.lower[1].item()) ** 2 <= square <= Fraction(tube.upper[1].item()) ** 2
    assert tube.width[1].item() < 1e-13


@pytest.mark.parametrize(
    "step",
    [
        lambda x, w: torch.einsum("ij,k->k", torch.full((3, 3), 0.1), x),
        lambda x, w: torch.addmm(x[None, :1], C32[None], D32[None])[0].expand(2) * 1.0,
        lambda x, w: torch.addcdiv(x, torch.tensor([1.0]), torch.tensor([3.0])),
    ],
    ids=["einsum", "addmm", "addcdiv"],
)
def test_sums_and_quotients_of_constants_inside_one_operation_are_refused(step):
    with pytest.raises(UnsupportedOperationError, match="before"):
        reach(step, Box.around([1.0, 2.0], [0.1, 0.1]), NONE, 1, batched=False)
