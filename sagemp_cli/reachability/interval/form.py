"""Intervals: values that answer torch's operations and know nothing but two bounds per entry, both rounded outwards."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from sagemp_cli.errors import UnsupportedOperationError
from sagemp_cli.reachability.form import ANGLE, Form, Handler, Operation, registers
from sagemp_cli.sets import round_down, round_up
from sagemp_cli.sets.rounding import TINY, UNIT


class IntervalForm(Form):
    """Every value between ``lower`` and ``upper``, entry by entry; infinite where nothing is known."""

    __slots__ = ("lower", "upper")

    def __init__(self, lower: Tensor, upper: Tensor) -> None:
        self.lower = torch.nan_to_num(lower, nan=-math.inf, posinf=math.inf, neginf=-math.inf)
        self.upper = torch.nan_to_num(upper, nan=math.inf, posinf=math.inf, neginf=-math.inf)

    @property
    def shape(self) -> torch.Size:
        """Shape of either bound."""
        return self.lower.shape

    def dim(self) -> int:
        """Number of dimensions."""
        return self.lower.dim()

    @property
    def dtype(self) -> torch.dtype:
        """Always float64."""
        return self.lower.dtype

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
        return self.lower.device

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper bound."""
        return self.lower, self.upper

    def relaxed(self, name: str, operation: Operation, *parameters: Any) -> IntervalForm:
        """The range of a function's values."""
        return IntervalForm(*operation.value_range(self.lower, self.upper, *parameters))

    def angle(self, x: IntervalForm) -> IntervalForm:
        """The range of the angles."""
        return IntervalForm(*ANGLE.value_range(*self.bounds(), *x.bounds()))

    def __getitem__(self, index: Any) -> IntervalForm:
        return IntervalForm(self.lower[index], self.upper[index])


HANDLERS: dict[Any, Handler] = {}
"""Torch function to its implementation on intervals."""

IntervalForm.handlers = HANDLERS
handles = registers(HANDLERS)


def _outwards(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """The next floats outside of bounds that were rounded to nearest."""
    return round_down(lower), round_up(upper)


def _signed(low: Tensor, high: Tensor, not_negative: Tensor, not_positive: Tensor) -> IntervalForm:
    """Bounds whose rounding does not cross 0 where the sign is known: there a root or a quotient has its end."""
    return IntervalForm(
        torch.where(not_negative, low.clamp(min=0.0), low), torch.where(not_positive, high.clamp(max=0.0), high)
    )


def _signs(a: IntervalForm, b: IntervalForm) -> tuple[Tensor, Tensor]:
    """Where a product or quotient is not negative, and where it is not positive."""
    up_a, down_a, up_b, down_b = a.lower >= 0, a.upper <= 0, b.lower >= 0, b.upper <= 0
    return (up_a & up_b) | (down_a & down_b), (up_a & down_b) | (down_a & up_b)


def _interval(value: Any) -> IntervalForm:
    if isinstance(value, IntervalForm):
        return value
    number = torch.as_tensor(value, dtype=torch.float64)
    return IntervalForm(number, number)


def _moving(*functions: Callable[..., Any]) -> None:
    """Register functions that only move entries."""
    for function in functions:

        @handles(function)
        def move(x: IntervalForm, *args: Any, _function: Callable[..., Any] = function, **kwargs: Any) -> Any:
            lower, upper = _function(x.lower, *args, **kwargs), _function(x.upper, *args, **kwargs)
            if isinstance(lower, Tensor):
                return IntervalForm(lower, upper)
            return tuple(IntervalForm(*pair) for pair in zip(lower, upper, strict=True))


_moving(torch.unbind, torch.Tensor.unbind, torch.flatten, torch.Tensor.flatten, torch.unsqueeze, torch.Tensor.unsqueeze)
_moving(torch.squeeze, torch.Tensor.squeeze, torch.reshape, torch.Tensor.reshape, torch.Tensor.expand)


@handles(torch.stack)
def stack(values: Sequence[Any], dim: int = 0) -> IntervalForm:
    """Stack intervals and constants."""
    return _joined(torch.stack, values, dim)


@handles(torch.cat, torch.concat, torch.concatenate)
def cat(values: Sequence[Any], dim: int = 0) -> IntervalForm:
    """Concatenate intervals and constants."""
    return _joined(torch.cat, values, dim)


def _joined(join: Callable[..., Tensor], values: Sequence[Any], dim: int) -> IntervalForm:
    forms = [_interval(v) for v in values]
    return IntervalForm(join([f.lower for f in forms], dim), join([f.upper for f in forms], dim))


@handles(torch.neg, torch.Tensor.neg, torch.Tensor.__neg__)
def negate(a: IntervalForm) -> IntervalForm:
    """Negation (exact)."""
    return IntervalForm(-a.upper, -a.lower)


@handles(torch.add, torch.Tensor.add, torch.Tensor.__add__, torch.Tensor.__radd__)
def add(a: Any, b: Any, *, alpha: float = 1) -> IntervalForm:
    """Sum."""
    a, b = _interval(a), _interval(b if alpha == 1 else multiply(b, alpha))
    low, high = _outwards(a.lower + b.lower, a.upper + b.upper)
    return _signed(low, high, (a.lower >= 0) & (b.lower >= 0), (a.upper <= 0) & (b.upper <= 0))


@handles(torch.sub, torch.Tensor.sub, torch.Tensor.__sub__)
def subtract(a: Any, b: Any, *, alpha: float = 1) -> IntervalForm:
    """Difference."""
    return add(a, negate(_interval(b)), alpha=alpha)


@handles(torch.rsub, torch.Tensor.__rsub__)
def reverse_subtract(a: Any, b: Any) -> IntervalForm:
    """``b - a``."""
    return subtract(b, a)


@handles(torch.mul, torch.Tensor.mul, torch.Tensor.__mul__, torch.Tensor.__rmul__)
def multiply(a: Any, b: Any) -> IntervalForm:
    """Product; of one value with itself the square."""
    if a is b:
        return torch.square(a)
    a, b = _interval(a), _interval(b)
    corners = torch.stack(torch.broadcast_tensors(*(x * y for x in a.bounds() for y in b.bounds())))
    return _signed(*_outwards(corners.amin(0), corners.amax(0)), *_signs(a, b))


@handles(torch.div, torch.Tensor.div, torch.true_divide, torch.Tensor.__truediv__)
def divide(a: Any, b: Any) -> IntervalForm:
    """Quotient; unbounded where the denominator may be 0."""
    a, b = _interval(a), _interval(b)
    corners = torch.stack(torch.broadcast_tensors(*(x / y for x in a.bounds() for y in b.bounds())))
    pole = (b.lower <= 0) & (b.upper >= 0)
    found = _signed(*_outwards(corners.amin(0), corners.amax(0)), *_signs(a, b))
    return IntervalForm(torch.where(pole, -math.inf, found.lower), torch.where(pole, math.inf, found.upper))


@handles(torch.nn.functional.linear)
def linear(x: IntervalForm, weight: Tensor, bias: Tensor | None = None) -> IntervalForm:
    """``x W^T + b``; the sums round by at most gamma times the sums of absolute values (Higham 2002, section 3.1)."""
    apply = torch.nn.functional.linear
    positive, negative = weight.clamp(min=0.0), weight.clamp(max=0.0)
    size = apply(torch.maximum(x.lower.abs(), x.upper.abs()), weight.abs(), None if bias is None else bias.abs())
    margin = size * ((2 * weight.shape[-1] + 8) * UNIT) + TINY
    low = apply(x.lower, positive, bias) + apply(x.upper, negative)
    high = apply(x.upper, positive, bias) + apply(x.lower, negative)
    # No term of a sum is negative if the negative ones add up to 0, which is exact then.
    below = apply(x.lower.clamp(max=0.0), positive) + apply(x.upper.clamp(min=0.0), negative)
    above = apply(x.upper.clamp(min=0.0), positive) + apply(x.lower.clamp(max=0.0), negative)
    offset = torch.zeros(weight.shape[0], dtype=weight.dtype) if bias is None else bias
    return _signed(low - margin, high + margin, (below == 0) & (offset >= 0), (above == 0) & (offset <= 0))


@handles(torch.matmul, torch.Tensor.matmul, torch.Tensor.__matmul__)
def matrix_product(x: Any, y: Any) -> IntervalForm:
    """``x @ W`` for a constant matrix."""
    if isinstance(y, IntervalForm) or y.dim() != 2:
        raise UnsupportedOperationError("torch.matmul is supported as x @ W with a constant two-dimensional W")
    return linear(x, y.transpose(0, 1))


@handles(torch.sum, torch.Tensor.sum)
def total(x: IntervalForm, dim: Any = None, keepdim: bool = False) -> IntervalForm:
    """Sum over one dimension."""
    if not isinstance(dim, int):
        raise UnsupportedOperationError(f"torch operation 'sum' is supported over one dimension, found dim={dim}")
    size = torch.maximum(x.lower.abs(), x.upper.abs()).sum(dim, keepdim)
    margin = size * ((x.shape[dim] + 4) * UNIT) + TINY
    low, high = x.lower.sum(dim, keepdim) - margin, x.upper.sum(dim, keepdim) + margin
    return _signed(low, high, (x.lower >= 0).all(dim, keepdim), (x.upper <= 0).all(dim, keepdim))


@handles(torch.maximum, torch.fmax, torch.Tensor.maximum, torch.Tensor.fmax)
def maximum(a: Any, b: Any) -> IntervalForm:
    """The larger one, exactly."""
    a, b = _interval(a), _interval(b)
    return IntervalForm(torch.maximum(a.lower, b.lower), torch.maximum(a.upper, b.upper))


@handles(torch.minimum, torch.fmin, torch.Tensor.minimum, torch.Tensor.fmin)
def minimum(a: Any, b: Any) -> IntervalForm:
    """The smaller one, exactly."""
    a, b = _interval(a), _interval(b)
    return IntervalForm(torch.minimum(a.lower, b.lower), torch.minimum(a.upper, b.upper))
