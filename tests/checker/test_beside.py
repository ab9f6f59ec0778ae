"""Intervals of combinations: nothing that may count is left out."""

import pytest

from sagemp_cli.checker.balls import BITS, arb, ctx
from sagemp_cli.checker.beside import Beside, Combinations

from .by_hand import line, program

SMALL, LARGE = 2.0**-140, 2.0**200


@pytest.mark.parametrize(("low", "high"), [(0.0, LARGE), (-LARGE, 0.0)])
def test_a_coefficient_that_rounding_cannot_tell_from_0_counts(low, high):
    """``(x + x 2^-140) - x``: 128 bits are kept of the sum's coefficient, that of the difference is a ball around 0."""
    made = program(
        line("linear", 0, constants=[1.0, SMALL, 0.0, 0.0]),
        line("linear", 2, constants=[1.0, 1.0, 0.0]),
        line("sub", 3, 0),
        n=1,
        next=4,
    )
    with ctx.workprec(BITS):
        ends = [(arb(low), arb(high)), (arb(0), arb(0))]
        ((least, most),) = Beside(Combinations(made, {}), ends).output(made.next)
        assert least <= arb(low) * arb(SMALL) and most >= arb(high) * arb(SMALL)
        assert most - least < 2.0**80
