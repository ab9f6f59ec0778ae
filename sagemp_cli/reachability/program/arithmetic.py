"""Arithmetic and functions of single entries on traced values."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

import sagemp_cli.reachability.relaxations.registry  # noqa: F401  (registers the functions that have a relaxation)
from sagemp_cli.errors import NonFiniteError, UnsupportedOperationError
from sagemp_cli.reachability.form import SHARED, unsupported
from sagemp_cli.reachability.program.constants import exact_parts
from sagemp_cli.reachability.program.value import ANSWERS, Traced, answers, exact, ids_of, is_tensor, recorder_of


def elementwise(function: Any, *args: Any, **kwargs: Any) -> Traced:
    """A function entry by entry; tensors among the arguments are broadcast, numbers stay numbers."""
    name = function.__name__
    recorder = recorder_of(*args, *kwargs.values())
    shapes = [np.shape(v) if isinstance(v, np.ndarray) else v.shape for v in (*args, *kwargs.values()) if is_tensor(v)]
    shape = torch.Size(np.broadcast_shapes(*shapes))  # torch's own imports a thousand modules

    def operand(value: Any) -> Any:
        if is_tensor(value):
            return recorder.operand(ids_of(recorder, value, name).expand(shape))
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            exact(value, operation=name)
        return value

    if 0 in shape:
        return Traced(recorder, torch.empty(shape, dtype=torch.int64))
    result = recorder.write(
        _callable(function, name), *(operand(v) for v in args), **{key: operand(v) for key, v in kwargs.items()}
    )
    if result.numel() not in (1, shape.numel()):
        raise unsupported(name)
    return Traced(
        recorder, result.reshape(shape if result.numel() == shape.numel() else [1] * len(shape)).expand(shape).clone()
    )


for _relaxed in SHARED:
    ANSWERS[_relaxed] = functools.partial(elementwise, _relaxed)


@functools.cache
def _callable(function: Any, name: str) -> Callable[..., Any]:
    """The function as something that can be called on sets: methods of tensors are looked up on the value."""
    if getattr(torch.Tensor, name, None) is not function:
        return function

    def method(value: Any, *args: Any, **kwargs: Any) -> Any:
        return getattr(value, name)(*args, **kwargs)

    method.__name__ = name
    return method


def _sum(a: Any, b: Any) -> Any:
    return b + a if isinstance(a, Tensor) else a + b


def _difference(a: Any, b: Any) -> Any:
    return -b + a if isinstance(a, Tensor) else a - b


def _product(a: Any, b: Any) -> Any:
    return b * a if isinstance(a, Tensor) else a * b


def _quotient(a: Any, b: Any) -> Any:
    return torch.div(a, b)


def _negative(a: Any) -> Any:
    return -a


for _operation, _word in (
    (_sum, "add"),
    (_difference, "sub"),
    (_product, "mul"),
    (_quotient, "div"),
    (_negative, "neg"),
):
    _operation.__name__ = _word


@answers("add", "__add__", "__radd__")
def add(a: Any, b: Any, *, alpha: float = 1) -> Traced:
    """``a + alpha b``."""
    return add_scaled("add", a, b, alpha)


def add_scaled(name: str, a: Any, b: Any, factor: Any) -> Traced:
    """``a + factor b``, either of them a value, whatever else a constant."""
    if factor == 1:
        return elementwise(_sum, a, b)
    if isinstance(b, Traced):
        return elementwise(_sum, a, multiply(b, factor))
    return add_parts(a, exact_parts(name, lambda c, f: f * c, b, factor))


def add_parts(a: Traced, parts: list[Tensor]) -> Traced:
    """A value plus what is the sum of some constants."""
    return functools.reduce(functools.partial(elementwise, _sum), parts, a)


@answers("sub", "subtract", "__sub__")
def subtract(a: Any, b: Any, *, alpha: float = 1) -> Traced:
    """``a - alpha b``."""
    return elementwise(_difference, a, b) if alpha == 1 else add_scaled("sub", a, b, -alpha)


@answers("rsub", "__rsub__")
def reverse_subtract(a: Any, b: Any, *, alpha: float = 1) -> Traced:
    """``b - alpha a``."""
    return subtract(b, a, alpha=alpha)


@answers("mul", "multiply", "__mul__", "__rmul__")
def multiply(a: Any, b: Any) -> Any:
    """Product."""
    if not (isinstance(a, Traced) and isinstance(b, Traced)):
        return elementwise(_product, a, b)
    # A matrix of values often has constants in it (a rotation's zeros and ones): with these, products are linear.
    left, right = (v.ids for v in torch.broadcast_tensors(a, b))
    fixed = a.recorder.constant_entries(left) | a.recorder.constant_entries(right)
    if not bool(fixed.any()) or bool(fixed.all()):
        return elementwise(_product, a, b)
    ids = torch.empty(left.shape, dtype=torch.int64)
    for entries in (fixed, ~fixed):
        ids[entries] = _scaled(a._like(left[entries]), b._like(right[entries])).ids
    return a._like(ids)


def _scaled(a: Traced, b: Traced) -> Traced:
    """Products of vectors whose entries are constant in either, or in none."""
    constant = a.recorder.constant_entries
    swapped = constant(b.ids)
    first = torch.where(swapped, b.ids, a.ids)
    second = torch.where(swapped, a.ids, b.ids)
    if not a.recorder.is_constant(first):
        return elementwise(_product, a, b)
    return elementwise(_product, a._like(first), a._like(second))


@answers("div", "divide", "true_divide", "__truediv__", "__rtruediv__")
def divide(a: Any, b: Any, *, rounding_mode: str | None = None) -> Traced:
    """Quotient."""
    if rounding_mode is not None:
        raise unsupported(f"div(rounding_mode='{rounding_mode}')")
    return elementwise(_quotient, a, b)


@answers("neg", "negative", "__neg__")
def negate(a: Traced) -> Traced:
    """``-a``."""
    return elementwise(_negative, a)


@answers("pow", "__pow__", "float_power")
def power(a: Any, exponent: Any) -> Traced:
    """Powers whose exponent is a number."""
    if type(exponent) is not Traced and is_tensor(exponent) and math.prod(exponent.shape) == 1:
        exponent = exponent.item()
    if not isinstance(a, Traced) or type(exponent) not in (int, float):
        raise UnsupportedOperationError("torch operation 'pow' is supported with a number as exponent")
    return elementwise(torch.pow, a, exponent)


@answers("addcmul")
def add_product(a: Any, b: Any, c: Any, *, value: float = 1) -> Traced:
    """``a + value b c``."""
    if isinstance(b, Traced) or isinstance(c, Traced):
        return add_scaled("addcmul", a, multiply(b, c), value)
    return add_parts(a, exact_parts("addcmul", lambda *factors: math.prod(factors), value, b, c))


@answers("addcdiv")
def add_quotient(a: Any, b: Any, c: Any, *, value: float = 1) -> Traced:
    """``a + value b / c``."""
    if isinstance(b, Traced) or isinstance(c, Traced):
        return add_scaled("addcdiv", a, divide(b, c), value)
    if not bool(exact(c, operation="addcdiv").all()):
        raise NonFiniteError("constant of 'addcdiv' is 0 in the denominator")
    return add_parts(a, exact_parts("addcdiv", lambda v, n, d: v * n / d, value, b, c))


@answers("lerp")
def interpolate(a: Any, b: Any, weight: Any) -> Traced:
    """``a + weight (b - a)``."""
    if isinstance(a, Traced) or isinstance(b, Traced):
        return elementwise(_sum, a, multiply(elementwise(_difference, b, a), weight))
    parts = exact_parts("lerp", lambda start, end: end - start, a, b)
    return functools.reduce(functools.partial(elementwise, _sum), [multiply(weight, p) for p in parts], a)


@answers("hypot")
def hypotenuse(a: Any, b: Any) -> Traced:
    """``sqrt(a^2 + b^2)``."""
    if not isinstance(a, Traced):
        a, b = b, a
    square = elementwise(torch.square, a)
    if isinstance(b, Traced):
        return elementwise(torch.sqrt, elementwise(_sum, square, elementwise(torch.square, b)))
    return elementwise(torch.sqrt, add_parts(square, exact_parts("hypot", lambda c: c * c, b)))


@answers("dropout", "alpha_dropout", "feature_alpha_dropout", "dropout1d", "dropout2d", "dropout3d")
def dropout(x: Traced, p: float = 0.5, training: bool = True) -> Traced:
    """Nothing, once the module is in evaluation mode."""
    if training and p > 0:
        raise UnsupportedOperationError("dropout is random in training mode; call .eval() on the module first")
    return x._like(x.ids)
