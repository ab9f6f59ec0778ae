"""The one account of rounding: every bound of an error has its name and its argument here, and all callers use it.

A number as computed differs from the exact one by at most its *error* times its *magnitude*, where the magnitude obeys
the same recurrences with absolute values: sums add magnitudes and keep the larger error, products multiply, and each
operation adds its own roundings to the error (:func:`gamma`). Of float64 it is used that sums, products, quotients and
square roots are correctly rounded; functions have the margins that their relaxations are tested with.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

UNIT = 2.0**-53
"""Unit roundoff u of float64: a correctly rounded operation errs by at most ``u`` times its result."""

TINY = 1e-250
"""Absorbs underflow: far above every subnormal error, far below everything of interest."""

SAFETY = 1.0 + 1e-9
"""Covers what is of second order: see :func:`gamma`. Whoever adds up errors multiplies the sum with it once."""


def gamma(roundings: float) -> float:
    """Relative error of a number that so many roundings go into, but for what :data:`SAFETY` covers.

    A product of k factors ``1 + d`` or ``1 / (1 + d)`` with ``|d| <= u`` is ``1 + e`` with ``|e| <= k u / (1 - k u)``
    (Higham 2002, lemma 3.1). That is at most ``SAFETY k u`` for k up to 9 million; what is left of it serves for
    the roundings made in computing the magnitudes that errors are multiplied with, and for products of errors.
    """
    return roundings * UNIT


def slack(size: Any, roundings: float) -> Any:
    """What so many roundings of numbers of at most that size can be off by, together."""
    return size * gamma(roundings)


def dot(terms: int) -> float:
    """Of a scalar product, relative to that of the magnitudes: one rounding of each product, one less of the sums.

    In whatever order the sum is taken, and with or without fused multiply-add (Higham 2002, section 3.1).
    """
    return gamma(terms)


def at_least(count: int) -> float:
    """What makes a computed sum of ``count`` magnitudes an upper bound of the exact one, in whatever order it is taken.

    The computed sum is at least ``1 - gamma(count)`` times the exact one. Twice the first order is more than what makes
    up for it, and ``8`` more are for the factor itself, the products that the magnitudes may be, and one sum more.
    """
    return 1.0 + 2 * gamma(count + 8)


# -- what affine forms are made of -------------------------------------------------------------------------------------

BAND = gamma(4)
"""Of ``slope x + offset``: two roundings in a centre, one in a coefficient, one where the new variable's radius is
added to the magnitude, and one more."""

SHIFT = gamma(2)
"""Of ``a - q b`` and of ``x + q``: a product and a sum."""


ROUNDED = gamma(8)
"""What is recorded of a product's band beyond ``half``: that and ``middle`` are a sum and a difference of squares,
three roundings each, relative to the larger; beside that the smaller, near 0, may be lost in both."""


SUM = gamma(1)
"""Of ``a + b``."""


def combined(terms: int) -> float:
    """Of a fixed combination of so many basic values, relative to the sum of all magnitudes.

    Its parts (constants, numbers, state, disturbance, each result) are scalar products that have at most ``terms``
    terms together; adding the parts up takes one rounding each, and there are fewer parts than terms. 8 more are for
    the sum of constants, numbers and disturbance, which is made once for all steps.
    """
    return gamma(terms + 8)


def of_product(error: float) -> float:
    """Of ``c d + c Y + d X + middle`` for factors of that error: theirs, twice, and what is computed here.

    The centre takes three roundings, a coefficient three, and middle and half, which are sums of two squares, four each
    with the scaling; together less than 16.
    """
    return 2 * error + gamma(16)


def over_symbols(symbols: int, variables: int) -> float:
    """Of a radius: sums of magnitudes over all symbols, of coefficients times generators, relative to the magnitude.

    A state's part is a scalar product with the generators, of fewer terms than there are variables; its magnitudes are
    summed over the symbols, the others' over the variables. Twice that, because the radius is subtracted from a centre
    whose rounding is of the same size, and 64 more for the scaling of factors, blocks of symbols and the last sums.
    """
    return 2 * gamma(symbols + variables + 64)


def of_generators(states: int) -> float:
    """Of the next state's generators: products of its coefficients with those before, sums of ``states`` terms.

    Relative to the magnitude, which bounds all of a row together; twice, and 16 more for radii and the last sum.
    """
    return gamma(2 * states + 16)


def round_down(value: Any) -> Any:
    """The next float64 below each entry (infinities stay); of tensors or of arrays."""
    if isinstance(value, np.ndarray):
        return np.nextafter(value, -math.inf)
    return torch.nextafter(value, torch.full_like(value, -math.inf))


def round_up(value: Any) -> Any:
    """The next float64 above each entry (infinities stay); of tensors or of arrays."""
    if isinstance(value, np.ndarray):
        return np.nextafter(value, math.inf)
    return torch.nextafter(value, torch.full_like(value, math.inf))
