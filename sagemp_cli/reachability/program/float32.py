"""Operations on recorded values in float32: which are known, and what rounds where.

A value that ``x.float()`` gives is float32, as all that torch computes of float32 values; ``.double()`` ends it. What
is written into the program is the exact operation and after it what float32 arithmetic makes of its result.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.errors import UnsupportedOperationError

EXACT = (
    "neg", "abs", "relu", "clamp", "maximum", "minimum", "identity", "where", "positive", "sign", "floor", "ceil",
    "round", "trunc",
)  # fmt: skip
"""Kinds of instructions that make float32 numbers of float32 numbers."""

ROUNDED = ("add", "sub", "mul", "div", "sqrt", "reciprocal", "leaky_relu")
"""Those that IEEE arithmetic rounds once."""

NEAR = ("tanh", "sigmoid", "exp", "log", "sin", "cos", "atan", "atan2", "elu", "softplus", "pow")
"""Those that a library computes."""

_WORDS = """
    add sub subtract rsub mul multiply div divide true_divide neg negative abs absolute sqrt reciprocal square pow relu
    leaky_relu relu6 hardtanh clamp clip clamp_min clamp_max maximum minimum fmax fmin max min amax amin tanh sigmoid
    special_expit exp log sin cos atan arctan atan2 arctan2 elu softplus linear matmul mm mv bmm dot inner vdot addmm
    addmv sum mean cumsum diff einsum dropout zeros_like ones_like full_like new_zeros new_ones new_full pad to float
    type type_as cpu copy fill zero detach requires_grad expand_as view_as reshape_as radd rmul truediv rtruediv rmatmul
    where gt ge lt le greater greater_equal less less_equal sign floor ceil round trunc
"""
_KNOWN = frozenset(_WORDS.split())
"""Functions of torch whose float32 arithmetic is that of the instructions that they become, one after the other."""

CONVERSIONS = ("to", "float", "type", "type_as")
"""Functions that may make float32 values of others."""

_SHAPED = ("expand_as", "view_as", "reshape_as", "broadcast_tensors")
"""Functions that look at the shapes of other values only."""

_SMALLEST = 2.0**-126


def require_known(name: str, moves: Collection[str]) -> None:
    """Refuse a function of which nothing is known in float32; those that only move entries do nothing."""
    if name.strip("_") not in _KNOWN and name.strip("_") not in moves:
        raise unknown(name)


def error_kind(kind: str) -> str | None:
    """The instruction that stands for what float32 arithmetic does to the result of one of that kind; None: nothing.

    Raises:
        UnsupportedOperationError: nothing is known of it.
    """
    if kind in EXACT:
        return None
    if kind in ROUNDED:
        return "float32"
    if kind in NEAR:
        return "float32_near"
    raise unknown(kind)


def unknown(name: str) -> UnsupportedOperationError:
    """The error for an operation whose float32 arithmetic is not known."""
    return UnsupportedOperationError(
        f"torch operation '{name}' is not known in float32, known are sums, products, linear layers and "
        f"{', '.join((*ROUNDED[3:], *EXACT[2:6], *NEAR))}; convert with .double() before it"
    )


def as_float32(value: Any, name: str) -> Any:
    """Arguments with their numbers as torch takes them beside float32 values: rounded to float32.

    Raises:
        UnsupportedOperationError: an array, or a number that float32 has no normal number for.
    """
    if isinstance(value, dict):
        return {key: as_float32(one, name) for key, one in value.items()}
    if isinstance(value, (list, tuple)) and not hasattr(value, "_fields"):
        return type(value)([as_float32(one, name) for one in value])
    if isinstance(value, np.ndarray):
        raise UnsupportedOperationError(f"'{name}' of a float32 value and a numpy array; make it a float32 tensor")
    if name.startswith("pow") and not _held(value):
        raise UnsupportedOperationError(
            f"'{name}' of a float32 value and the exponent {value}, which is no float32 number: torch takes it as "
            f"rounded to float32 for some entries and as it is for others"
        )
    if isinstance(value, (float, np.floating)):
        return float(_narrowed(torch.tensor(float(value), dtype=torch.float64), name))
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > 2**24:
        raise UnsupportedOperationError(f"'{name}' of a float32 value and {value}, a whole number above 2^24")
    if type(value) is Tensor or isinstance(value, torch.nn.Parameter):
        if value.dtype is torch.float64 and value.dim():
            raise mixed(name)
        return _narrowed(value, name) if value.dtype not in (torch.bool,) else value
    return value


def require_one_type(name: str, args: Any, kind: type) -> None:
    """Refuse float64 values of the recording beside float32 ones, where the result is float32."""
    if name not in (*CONVERSIONS, *_SHAPED) and contains(args, kind, float32=False):
        raise mixed(name)


def mixed(name: str) -> UnsupportedOperationError:
    """The error for an operation of which torch would round a float64 operand to float32 by itself."""
    return UnsupportedOperationError(
        f"torch operation '{name}' mixes float32 and float64 and gives float32; convert with .float() or .double()"
    )


def _held(value: Any) -> bool:
    """Whether float32 has this number; of what is none, too."""
    if type(value) is Tensor or isinstance(value, torch.nn.Parameter):
        return not value.dtype.is_floating_point or torch.equal(value.to(torch.float32).to(value.dtype), value)
    return not isinstance(value, (float, np.floating)) or float(torch.tensor(float(value)).float()) == value


def _narrowed(constant: Tensor, name: str) -> Tensor:
    narrow = constant.to(torch.float32)
    if not constant.dtype.is_floating_point and not torch.equal(narrow.to(constant.dtype), constant):
        raise UnsupportedOperationError(f"'{name}' of a float32 value and whole numbers above 2^24")
    size = constant.detach().to(torch.float64).abs()
    odd = (size > 0) & ((size < _SMALLEST) | (torch.isfinite(size) & torch.isinf(narrow)))
    if bool(odd.any()):
        raise UnsupportedOperationError(
            f"constant {float(size[odd].flatten()[0]):.3g} of '{name}' is no normal number of float32, which range "
            f"from {_SMALLEST:.3g} to {torch.finfo(torch.float32).max:.3g}"
        )
    return narrow if constant.dtype.is_floating_point else constant


def contains(value: Any, kind: type, *, float32: bool) -> bool:
    """Whether there is a recorded value of that type among arguments."""
    if isinstance(value, dict):
        return any(contains(one, kind, float32=float32) for one in value.values())
    if isinstance(value, (list, tuple)):
        return any(contains(one, kind, float32=float32) for one in value)
    return isinstance(value, kind) and value.dtype is (torch.float32 if float32 else torch.float64)
