"""Which functions of torch make truth values of truth values as the numbers 1 and 0 are made, and which do not.

What torch converts to truth values by itself, as where a number is written into a mask, a set has not; and of truth
values torch takes sums for "or".
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

import numpy as np
from torch import Tensor

from sagemp_cli.errors import UnsupportedOperationError

_COMPARED = """
    lt less gt greater ge greater_equal le less_equal ne not_equal eq __lt__ __gt__ __ge__ __le__ __ne__ __eq__
"""
_COMPARISONS = frozenset(_COMPARED.split())
_OF_VALUES = """
    logical_not logical_and logical_or logical_xor bitwise_not bitwise_and bitwise_or bitwise_xor __and__ __rand__
    __or__ __ror__ __xor__ __rxor__ __invert__ __iand__ __ior__ __ixor__ mul multiply where masked_fill copy fill
    maximum minimum
"""
_LOGIC = frozenset(_OF_VALUES.split())
"""Functions that do to truth values what they do to the numbers 1 and 0."""

_WITH_OTHERS = "max min amax amin zero zeros_like ones_like new_zeros new_ones cpu to type type_as"
_LOGIC_OF_ONE = frozenset(_WITH_OTHERS.split())
"""The same, whose numbers are dimensions, shapes and types."""


def require_logic(name: str, arguments: Iterable[Any], kind: Any, *, moves: Collection[str]) -> None:
    """Refuse a function that gives truth values and takes others, or means something else of them than of numbers.

    Args:
        name: of the function.
        arguments: all of them.
        kind: the type of recorded values.
        moves: functions that only move entries.
    """
    plain = name if name.startswith("__") else name.rstrip("_")
    if plain in _COMPARISONS:
        return
    if plain in _LOGIC:
        require_truth(name, arguments, kind)
    elif plain in _LOGIC_OF_ONE or plain in moves:
        require_truth(name, arguments, kind, constants=False)
    else:
        raise UnsupportedOperationError(f"torch operation '{name}' of truth values is not supported; use .double()")


def require_truth(name: str, values: Iterable[Any], kind: Any, *, constants: bool = True) -> None:
    """Refuse values, and constants where these are asked for too, that torch would convert to truth values."""
    for value in values:
        if isinstance(value, (list, tuple)):
            require_truth(name, value, kind, constants=constants)
        elif not (value.truth if isinstance(value, kind) else not constants or _is_truth(value)):
            raise UnsupportedOperationError(f"'{name}' makes truth values of others; compare them with 0")


def _is_truth(value: Any) -> bool:
    """Whether a constant is one, or no number at all."""
    if isinstance(value, (Tensor, np.ndarray)):
        return str(value.dtype) in ("torch.bool", "bool")
    return not isinstance(value, (int, float, np.generic)) or value in (0, 1)
