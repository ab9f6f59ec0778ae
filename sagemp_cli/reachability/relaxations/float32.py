"""What float32 arithmetic does to a number, as relaxations: the number itself, give or take an error.

``docs/program.md`` says which errors and what is assumed of whoever computes. Here u is ``2^-24``:

- *one rounding*: a sum, product, quotient, root or conversion errs by at most ``u |a| + 2^-126``. The last term is for
  results that are subnormal, whether they are kept or flushed to 0.
- *near*: a function of a library (tanh, exp, ...) errs by at most ``8 u (1 + |a|)``; no standard says by how much.
- *sums* of products, in whatever order they are taken, in how many parts, with or without fused multiply-add, of c
  terms and a bias: each term goes through at most ``k = c + 1`` roundings, so that the sum errs by at most
  ``k u / (1 - k u)`` times the sum of the terms' sizes (Higham 2002, lemma 3.1 and section 3.1). Each of the ``2 k``
  results may also underflow by 2^-126, which later roundings at most double.

A number that may be larger than :data:`LARGEST` may overflow on the way: nothing is known of the result.
"""

from __future__ import annotations

import math
from typing import Any

from torch import Tensor

from sagemp_cli.reachability.relaxations.band import Band, settled
from sagemp_cli.reachability.relaxations.functions import functions_of
from sagemp_cli.reachability.relaxations.lines import Lines, parallel
from sagemp_cli.sets.rounding import SAFETY, round_down, round_up

UNIT = 2.0**-24
SMALLEST = 2.0**-126
LARGEST = 2.0**126

ERRORS: dict[str, tuple[float, float]] = {"float32": (UNIT, SMALLEST), "float32_near": (8 * UNIT, 8 * UNIT)}
"""Error relative to the number, and beside that, by kind of instruction."""


def _checked(size: Any, error: Any) -> Any:
    """The error where nothing overflows, else infinite; also where nothing is known of the size."""
    return functions_of(error).where(size < LARGEST, error, math.inf)


def error_of(lower: Any, upper: Any, relative: float, absolute: float) -> Any:
    """Bound of the error of a number of ``[lower, upper]``."""
    size = functions_of(lower).maximum(abs(lower), abs(upper))
    return _checked(size, (size * relative + absolute) * SAFETY)


def error_of_sums(size: Any, terms: int) -> Any:
    """Bound of the error of sums of so many products and a bias, from bounds of the sums of their sizes."""
    k = terms + 1
    if k * UNIT >= 0.5:
        return size + math.inf
    return _checked(size, (size * (k * UNIT / (1 - k * UNIT)) + 4 * k * SMALLEST) * SAFETY)


def sizes_of_sums(lower: Any, upper: Any, matrix: Any, bias: Any) -> Any:
    """Bounds of the sums of sizes ``|M| |a| + |b|``, of which matrix and bias are given.

    Args:
        lower, upper: of a, ``(..., c)``.
        matrix, bias: ``|M| (r, c)`` and ``|b|``.
    """
    size = functions_of(lower).maximum(abs(lower), abs(upper))
    return (size @ matrix.T + bias) * SAFETY  # whose rounding is at most (c + 2) 2^-53, c < 2^23


def band(lower: Any, upper: Any, relative: float, absolute: float) -> Band:
    """Band of what a number of ``[lower, upper]`` becomes; of tensors or of arrays."""
    return band_within(lower, upper, error_of(lower, upper, relative, absolute))


def lines(lower: Tensor, upper: Tensor, relative: float, absolute: float) -> Lines:
    """The same as lines."""
    return parallel(band(lower, upper, relative, absolute))


def value_range(lower: Any, upper: Any, relative: float, absolute: float) -> tuple[Any, Any]:
    """What it may be; of tensors or of arrays."""
    return widened(lower, upper, error_of(lower, upper, relative, absolute))


def band_within(lower: Any, upper: Any, error: Any, *_: Any) -> Band:
    """The same where the error is known."""
    one = functions_of(error).ones_like(error)
    return settled(one, 0.0 * one, error)


def lines_within(lower: Tensor, upper: Tensor, error: Tensor, *_: Any) -> Lines:
    """As lines."""
    return parallel(band_within(lower, upper, error))


def widened(lower: Any, upper: Any, error: Any, *_: Any) -> tuple[Any, Any]:
    """An interval and an error around it, rounded outwards."""
    return round_down(lower - error), round_up(upper + error)
