"""What one operation computes from constants alone, exactly: as numbers of float64 whose sum it is.

``torch.add(x, c, alpha=0.1)`` is ``x + 0.1 c`` in real arithmetic. The product, rounded, would be another constant; so
it is written as its rounded value and what is missing, which is a number of float64 too.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.errors import UnsupportedOperationError
from sagemp_cli.reachability.program.value import exact

_MOST_PARTS = 4
"""Most numbers that a constant may become; a product of three has no more, unless it underflows."""


def exact_parts(operation: str, function: Callable[..., Fraction], *constants: Any) -> list[Tensor]:
    """Tensors of one shape, the larger numbers first, whose exact sum is the function of the constants.

    Args:
        operation: its name in torch, for errors.
        function: on fractions, in exact arithmetic.
        constants: numbers, arrays or tensors that are broadcast.

    Raises:
        UnsupportedOperationError: a few numbers of float64 do not add up to the result (a third, an underflow).
    """
    held = [exact(c, operation=operation) for c in constants]
    shape = np.broadcast_shapes(*(tuple(h.shape) for h in held))
    rows = zip(*(h.expand(shape).flatten().tolist() for h in held), strict=True)
    split = [_split(function(*map(Fraction, row)), operation) for row in rows]
    count = max(map(len, split), default=1)
    return [
        torch.tensor([s[i] if i < len(s) else 0.0 for s in split], dtype=torch.float64).reshape(shape)
        for i in range(count)
    ]


def _split(number: Fraction, operation: str) -> list[float]:
    parts: list[float] = []
    rest = number
    while rest or not parts:
        try:
            part = float(rest)
        except OverflowError:
            part = 0.0
        if len(parts) == _MOST_PARTS or (rest and part == 0.0):
            raise UnsupportedOperationError(
                f"what '{operation}' computes from constants alone cannot be held exactly; compute it before, so that "
                f"its rounding is part of the step"
            )
        parts.append(part)
        rest -= Fraction(part)
    return parts
