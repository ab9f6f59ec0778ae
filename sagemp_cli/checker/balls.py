"""Balls of real numbers (Arb's ``arb``) and the two ways between them and float64."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from sagemp_cli.checker.unproved import Unproved
from sagemp_cli.errors import UsageError

try:
    from flint import arb, arb_mat, ctx
except ImportError:
    raise UsageError("checking needs python-flint; install it with: pip install 'sagemp[check]'") from None

__all__ = ["BITS", "arb", "arb_mat", "ball", "balls", "ctx", "nearest", "upper_float"]

BITS = 128
"""Precision of the balls' midpoints; a step's rounding is 2^-75 of that of float64."""


def ball(value: Any) -> arb:
    """The exact value of a float64 number; not a number and infinities are refused."""
    number = float(value)
    if not math.isfinite(number):
        raise Unproved(f"a number that must be finite is {number}")
    return arb(number)


def balls(values: Iterable[Any]) -> list[arb]:
    """The same for many."""
    return [ball(v) for v in values]


def nearest(value: arb) -> tuple[float, arb]:
    """A float64 number near a ball, and an upper bound of its distance to every point of the ball."""
    number = float(value.mid())
    return number, abs(value - ball(number)).upper()


def upper_float(value: arb) -> float:
    """A float64 number that is certainly not below any point of the ball."""
    number = math.nextafter(float(value.upper()), math.inf)
    if not value <= ball(number):  # a comparison of balls is true only if it holds for all of their points
        raise Unproved("a bound overflowed")
    return number
