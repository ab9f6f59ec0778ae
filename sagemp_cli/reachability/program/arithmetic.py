"""Arithmetic and functions of single entries on traced values: what torch's functions become in a program."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.errors import NonFiniteError, UnsupportedOperationError
from sagemp_cli.reachability.program.constants import exact_parts
from sagemp_cli.reachability.program.value import Traced, answers, exact, ids_of, is_tensor, recorder_of, unsupported

SOFTPLUS_LARGEST = 87.0
"""Threshold of a softplus in float32, below that of overflow: exp(87) is 2^125.5."""


def elementwise(kind: str, *operands: Any, name: str = "", limits: Sequence[Any] = (), numbers: Sequence[float] = ()):
    """An instruction on values, constants and numbers, entry by entry, which are broadcast.

    Args:
        kind: of the instruction.
        operands: one or two.
        name: torch's, for errors.
        limits: constants that are broadcast too, one vector each.
        numbers: constants that are single numbers.
    """
    name = name or kind
    recorder = recorder_of(*operands)
    tensors = [v for v in (*operands, *limits) if is_tensor(v)]
    # Not torch's own function, which imports a thousand modules.
    shape = torch.Size(np.broadcast_shapes(*(np.shape(v) if isinstance(v, np.ndarray) else v.shape for v in tensors)))
    if 0 in shape:
        return Traced(recorder, torch.empty(shape, dtype=torch.int64))
    vectors = [exact(v, operation=name).expand(shape).reshape(-1) for v in limits]
    uniform = all(bool((v == v[0]).all()) for v in vectors)
    read = [recorder.operand(ids_of(recorder, v, name).expand(shape), full=not uniform) for v in operands]
    if vectors and _size(recorder, read[0]) == 1:
        vectors = [v[:1] for v in vectors]
    constants = (*vectors, *(exact(v, operation=name).reshape(()) for v in numbers))
    result = recorder.rounded(kind, recorder.write(kind, read, constants))
    whole = result.numel() == shape.numel()
    return Traced(recorder, result.reshape(shape if whole else [1] * len(shape)).expand(shape).clone())


def _size(recorder: Any, operand: Any) -> int:
    return len(operand) if isinstance(operand, Tensor) else recorder.size_of(operand)


def _function(kind: str, *names: str) -> None:
    """A function of one value without constants."""

    @answers(kind, *names)
    def answer(x: Traced, inplace: bool = False) -> Traced:
        return elementwise(kind, x)


_function("neg", "negative", "__neg__")
_function("sin")
_function("cos")
_function("tan")
_function("atan", "arctan")
_function("tanh")
_function("sigmoid", "special_expit")
_function("silu")
_function("exp")
_function("log")
_function("sqrt")
_function("abs", "absolute", "__abs__")
_function("reciprocal")
_function("relu")


@answers("add", "__add__", "__radd__")
def add(a: Any, b: Any, *, alpha: float = 1) -> Traced:
    """``a + alpha b``."""
    return add_scaled("add", a, b, alpha)


def add_scaled(name: str, a: Any, b: Any, factor: Any) -> Traced:
    """``a + factor b``, either of them a value, whatever else a constant."""
    if factor == 1:
        return elementwise("add", a, b)
    if isinstance(b, Traced):
        return elementwise("add", a, multiply(b, factor))
    return add_parts(a, exact_parts(name, lambda c, f: f * c, b, factor))


def add_parts(a: Traced, parts: list[Tensor]) -> Traced:
    """A value plus what is the sum of some constants."""
    if a.recorder.float32:
        raise UnsupportedOperationError(
            "an operation that computes something from constants alone is not known in float32; compute it before"
        )
    return functools.reduce(functools.partial(elementwise, "add"), parts, a)


@answers("sub", "subtract", "__sub__")
def subtract(a: Any, b: Any, *, alpha: float = 1) -> Traced:
    """``a - alpha b``."""
    return elementwise("sub", a, b) if alpha == 1 else add_scaled("sub", a, b, -alpha)


@answers("rsub", "__rsub__")
def reverse_subtract(a: Any, b: Any, *, alpha: float = 1) -> Traced:
    """``b - alpha a``."""
    return subtract(b, a, alpha=alpha)


@answers("mul", "multiply", "__mul__", "__rmul__")
def multiply(a: Any, b: Any) -> Any:
    """Product."""
    if not (isinstance(a, Traced) and isinstance(b, Traced)):
        return elementwise("mul", a, b)
    # A matrix of values often has constants in it (a rotation's zeros and ones): with these, products are linear.
    left, right = (v.ids for v in torch.broadcast_tensors(a, b))
    fixed = a.recorder.constant_entries(left) | a.recorder.constant_entries(right)
    if not bool(fixed.any()) or bool(fixed.all()):
        return elementwise("mul", a, b)
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
        return elementwise("mul", a, b)
    return elementwise("mul", a._like(first), a._like(second))


@answers("div", "divide", "true_divide", "__truediv__", "__rtruediv__")
def divide(a: Any, b: Any, *, rounding_mode: str | None = None) -> Traced:
    """Quotient."""
    if rounding_mode is not None:
        raise unsupported(f"div(rounding_mode='{rounding_mode}')")
    return elementwise("div", a, b)


@answers("square")
def square(x: Traced) -> Traced:
    """``x^2``."""
    return power(x, 2)


@answers("pow", "__pow__", "float_power")
def power(a: Any, exponent: Any) -> Traced:
    """Powers with a number as exponent; those that are not whole, of values that are not negative."""
    if type(exponent) is not Traced and is_tensor(exponent) and math.prod(exponent.shape) == 1:
        exponent = exponent.item()
    if not isinstance(a, Traced) or type(exponent) not in (int, float):
        raise UnsupportedOperationError("torch operation 'pow' is supported with a number as exponent")
    if exponent == 0.5:
        return elementwise("sqrt", a)
    if not math.isfinite(exponent):
        raise UnsupportedOperationError(f"torch operation 'pow' is supported with a finite exponent, found {exponent}")
    if exponent == 1:
        return a._like(a.ids.clone())
    if exponent == 0:
        return a._like(ids_of(a.recorder, 1.0, "pow").expand(a.shape).clone())
    return elementwise("pow", a, numbers=(float(exponent),))


@answers("leaky_relu")
def leaky_relu(x: Traced, negative_slope: float = 0.01, inplace: bool = False) -> Traced:
    """Leaky ReLU."""
    if not negative_slope <= 1:
        above = elementwise("relu", x)
        return add(above, multiply(subtract(x, above), negative_slope))
    return elementwise("leaky_relu", x, numbers=(negative_slope,))


@answers("softplus")
def softplus(x: Traced, beta: float = 1.0, threshold: float = 20.0) -> Traced:
    """Softplus."""
    if not beta > 0:
        raise UnsupportedOperationError(f"softplus is supported with a positive beta, found {beta}")
    if x.recorder.float32 and threshold > SOFTPLUS_LARGEST:
        raise UnsupportedOperationError(
            f"softplus in float32 is supported with a threshold of at most {SOFTPLUS_LARGEST:g}, found {threshold}: "
            f"beyond, its exponential may overflow"
        )
    return elementwise("softplus", x, numbers=(beta, threshold))


@answers("clamp", "clip")
def clamp(x: Any, min: Any = None, max: Any = None) -> Traced:  # noqa: A002  (torch's names)
    """Clamp; limits that are values themselves go through maximum and minimum."""
    if not isinstance(x, Traced) or isinstance(min, Traced) or isinstance(max, Traced):
        x = x if min is None else maximum(x, _tensor(min))
        return x if max is None else minimum(x, _tensor(max))
    limits = [side if v is None else v for v, side in ((min, -math.inf), (max, math.inf))]
    return elementwise("clamp", x, limits=limits)


@answers("clamp_min")
def clamp_min(x: Traced, min: Any) -> Traced:  # noqa: A002
    """Clamp from below."""
    return clamp(x, min)


@answers("clamp_max")
def clamp_max(x: Traced, max: Any) -> Traced:  # noqa: A002
    """Clamp from above."""
    return clamp(x, None, max)


@answers("hardtanh")
def hardtanh(x: Traced, min_val: float = -1.0, max_val: float = 1.0, inplace: bool = False) -> Traced:
    """Clamp to fixed limits."""
    return clamp(x, min_val, max_val)


@answers("relu6")
def relu6(x: Traced, inplace: bool = False) -> Traced:
    """Clamp to [0, 6]."""
    return clamp(x, 0.0, 6.0)


@answers("maximum", "fmax")
def maximum(a: Any, b: Any) -> Traced:
    """The larger one."""
    if isinstance(a, Traced) and isinstance(b, Traced):
        return elementwise("maximum", a, b)
    return clamp(a, b) if isinstance(a, Traced) else clamp(b, a)


@answers("minimum", "fmin")
def minimum(a: Any, b: Any) -> Traced:
    """The smaller one."""
    if isinstance(a, Traced) and isinstance(b, Traced):
        return elementwise("minimum", a, b)
    return clamp(a, None, b) if isinstance(a, Traced) else clamp(b, None, a)


@answers("atan2", "arctan2")
def arctangent2(y: Any, x: Any) -> Traced:
    """Angle of the point (x, y); of sine and cosine of one value that value, less whole turns."""
    if isinstance(y, Traced) and isinstance(x, Traced) and y.shape == x.shape:
        ids = x.recorder.angle_of(y.ids, x.ids)
        if ids is not None:
            return elementwise("wrap", x._like(ids), name="atan2")
    return elementwise("atan2", y, x)


def identity(x: Any) -> Any:
    """A value of which a proof keeps nothing but its bounds; of numbers they themselves."""
    return elementwise("identity", x) if isinstance(x, Traced) else x


@answers("addcmul")
def add_product(a: Any, b: Any, c: Any, *, value: float = 1) -> Traced:
    """``a + value b c``."""
    if isinstance(b, Traced) or isinstance(c, Traced):
        return add_scaled("addcmul", a, multiply(b, c), value)
    return add_parts(a, exact_parts("addcmul", lambda *factors: Fraction(math.prod(factors)), value, b, c))


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
        return elementwise("add", a, multiply(elementwise("sub", b, a), weight))
    parts = exact_parts("lerp", lambda start, end: end - start, a, b)
    return functools.reduce(functools.partial(elementwise, "add"), [multiply(weight, p) for p in parts], a)


@answers("hypot")
def hypotenuse(a: Any, b: Any) -> Traced:
    """``sqrt(a^2 + b^2)``."""
    if not isinstance(a, Traced):
        a, b = b, a
    if isinstance(b, Traced):
        return elementwise("sqrt", elementwise("add", square(a), square(b)))
    return elementwise("sqrt", add_parts(square(a), exact_parts("hypot", lambda c: c * c, b)))


def _tensor(value: Any) -> Any:
    return value if isinstance(value, Traced) else torch.as_tensor(value, dtype=torch.float64)


@answers("dropout", "alpha_dropout", "feature_alpha_dropout", "dropout1d", "dropout2d", "dropout3d")
def dropout(x: Traced, p: float = 0.5, training: bool = True) -> Traced:
    """Nothing, once the module is in evaluation mode."""
    if training and p > 0:
        raise UnsupportedOperationError("dropout is random in training mode; call .eval() on the module first")
    return x._like(x.ids)
