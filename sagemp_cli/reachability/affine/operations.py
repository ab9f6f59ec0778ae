"""Torch's linear operations, products and quotients on affine forms: one function each.

Importing this module is what gives :class:`~sagemp_cli.reachability.affine.form.AffineForm` its handlers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from sagemp_cli.errors import UnsupportedOperationError
from sagemp_cli.reachability.affine.form import SAFETY, AffineForm, Factors, Relaxed, StepFrame
from sagemp_cli.reachability.form import registers
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.sets.rounding import TINY, UNIT

HANDLERS: dict[Any, Callable[..., Any]] = {}
"""Torch function to its implementation on affine forms; one line per function."""

AffineForm.handlers = HANDLERS
handles = registers(HANDLERS)


def _frame_of(*values: Any) -> StepFrame:
    return next(v.frame for v in values if isinstance(v, AffineForm))


def constant(value: Any, like: Tensor) -> Tensor:
    """A number or tensor as float64 tensor."""
    return torch.as_tensor(value, dtype=torch.float64, device=like.device)


def _broadcast(a: torch.Size, b: torch.Size) -> torch.Size:
    """Shape of a broadcast (torch's own function is slow)."""
    if a == b or not b:
        return a
    short, long = sorted((a, b), key=len)
    shape = list(long)
    for i in range(1, len(short) + 1):
        if short[-i] != 1 and shape[-i] not in (1, short[-i]):
            return torch.broadcast_shapes(a, b)  # raises torch's own error
        shape[-i] = max(shape[-i], short[-i]) if short[-i] and shape[-i] else 0
    return torch.Size(shape)


def _expand(form: AffineForm, shape: torch.Size, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Centre, coefficients (padded with zeros to ``size`` variables) and magnitude, broadcast to ``shape``."""
    coefficients = form.coefficients
    if coefficients.shape[0] == size and form.center.shape == shape:
        return form.center, coefficients, form.magnitude
    missing = len(shape) - (coefficients.dim() - 1)
    if missing:
        coefficients = coefficients.reshape(coefficients.shape[0], *[1] * missing, *coefficients.shape[1:])
    if coefficients.shape[1:] != shape:
        coefficients = coefficients.expand(coefficients.shape[0], *shape)
    gap = size - coefficients.shape[0]
    if gap:
        coefficients = torch.cat([coefficients, coefficients.new_zeros(gap, *shape)])
    return form.center.expand(shape), coefficients, form.magnitude.expand(shape)


@handles(torch.add, torch.Tensor.add, torch.Tensor.__add__, torch.Tensor.__radd__)
def add(a: Any, b: Any, *, alpha: float = 1) -> AffineForm:
    """Sum of forms and constants."""
    if alpha != 1:
        # A constant of less precision would be rounded to it.
        b = multiply(b, alpha) if isinstance(b, AffineForm) else torch.as_tensor(b, dtype=torch.float64) * alpha
    if not isinstance(a, AffineForm):
        a, b = b, a
    if not isinstance(b, AffineForm):
        value = constant(b, a.center)
        shape = _broadcast(a.shape, value.shape)
        center, coefficients, magnitude = _expand(a, shape, a.coefficients.shape[0])
        # Two units: the second is for the rounding of alpha times the constant.
        return AffineForm(a.frame, center + value, coefficients, magnitude + value.abs(), a.error + 2 * UNIT)
    shape = _broadcast(a.shape, b.shape)
    size = max(a.coefficients.shape[0], b.coefficients.shape[0])
    (c1, g1, m1), (c2, g2, m2) = _expand(a, shape, size), _expand(b, shape, size)
    return AffineForm(a.frame, c1 + c2, g1 + g2, m1 + m2, max(a.error, b.error) + UNIT)


@handles(torch.sub, torch.Tensor.sub, torch.Tensor.__sub__)
def subtract(a: Any, b: Any, *, alpha: float = 1) -> AffineForm:
    """Difference."""
    return add(
        a, multiply(b, -alpha) if isinstance(b, AffineForm) else b, alpha=1 if isinstance(b, AffineForm) else -alpha
    )


@handles(torch.rsub, torch.Tensor.__rsub__)
def reverse_subtract(a: Any, b: Any) -> AffineForm:
    """``b - a``."""
    return subtract(b, a)


@handles(torch.neg, torch.Tensor.neg, torch.Tensor.__neg__)
def negate(a: AffineForm) -> AffineForm:
    """Negation (exact)."""
    return AffineForm(a.frame, -a.center, -a.coefficients, a.magnitude, a.error)


@handles(torch.mul, torch.Tensor.mul, torch.Tensor.__mul__, torch.Tensor.__rmul__)
def multiply(a: Any, b: Any) -> AffineForm:
    """Product with a constant, or of two forms."""
    if not isinstance(a, AffineForm):
        a, b = b, a
    if isinstance(b, AffineForm):
        return _product(a, b)
    if isinstance(b, (int, float)):
        if b == 1:
            return a
        b = float(b)
        return AffineForm(a.frame, a.center * b, a.coefficients * b, a.magnitude * abs(b) + TINY, a.error + UNIT)
    value = constant(b, a.center)
    shape = _broadcast(a.shape, value.shape)
    center, coefficients, magnitude = _expand(a, shape, a.coefficients.shape[0])
    return AffineForm(a.frame, center * value, coefficients * value, magnitude * value.abs() + TINY, a.error + UNIT)


@handles(torch.div, torch.Tensor.div, torch.true_divide, torch.Tensor.__truediv__)
def divide(a: Any, b: Any) -> AffineForm:
    """Quotient with a constant denominator, or of two forms by way of the reciprocal."""
    if isinstance(b, AffineForm):
        if not isinstance(a, AffineForm):
            return multiply(torch.reciprocal(b), a)
        # a / b = q + (a - q b) / b for any q: near the centres' quotient what the two share cancels before the product.
        q = (a.center / b.center).detach().nan_to_num(0.0, 0.0, 0.0)
        return add(multiply(subtract(a, multiply(b, q)), torch.reciprocal(b)), q)
    value = constant(b, a.center)
    shape = _broadcast(a.shape, value.shape)
    center, coefficients, magnitude = _expand(a, shape, a.coefficients.shape[0])
    return AffineForm(a.frame, center / value, coefficients / value, magnitude / value.abs() + TINY, a.error + 2 * UNIT)


def _spread_to(form: AffineForm, shape: torch.Size, coefficients: Tensor, size: int) -> Tensor:
    """:meth:`AffineForm.spread` of a form that was broadcast to ``shape`` and padded to ``size`` variables."""
    if form.shape != shape:
        return AffineForm(form.frame, form.center.expand(shape), coefficients, form.magnitude, form.error).spread()
    gap = size - form.coefficients.shape[0]
    return torch.nn.functional.pad(form.spread(), (0, gap)) if gap else form.spread()


def _product(a: AffineForm, b: AffineForm) -> AffineForm:
    """Product of two forms whose deviations may be correlated.

    ``(c + X)(d + Y) = c d + c Y + d X + X Y`` and, with ``P = l X + Y / l`` and ``M = l X - Y / l`` for any l > 0,
    ``X Y = (P^2 - M^2) / 4`` lies in ``[-r_M^2 / 4, r_P^2 / 4]``: equal to the usual ``r_X r_Y`` for independent
    operands, up to half as wide for correlated ones (exact for a square). Best is ``l = sqrt(r_Y / r_X)``.
    """
    frame = a.frame
    shape = _broadcast(a.shape, b.shape)
    size = max(a.coefficients.shape[0], b.coefficients.shape[0])
    (c, gx, mx), (d, gy, my) = _expand(a, shape, size), _expand(b, shape, size)
    error = max(a.error, b.error)
    rows_x = _spread_to(a, shape, gx, size)
    rows_y = _spread_to(b, shape, gy, size)
    # Rounding of the rows, of their sums, and of scaling (2 more units each) is within twice the usual slack.
    share = 2 * (error + frame.sum_error) * SAFETY
    slack_x, slack_y = mx * share, my * share
    with torch.no_grad():
        radius_x = rows_x.abs().sum(-1).reshape(shape) + slack_x
        radius_y = rows_y.abs().sum(-1).reshape(shape) + slack_y
        ratio = torch.sqrt(radius_y / radius_x)
    scale = ratio.reshape(rows_x.shape[:-1])[..., None]
    scaled_x, scaled_y = rows_x * scale, rows_y / scale
    slack = (slack_x * ratio + slack_y / ratio) * SAFETY
    plus = (scaled_x + scaled_y).abs().sum(-1).reshape(shape) + slack
    minus = (scaled_x - scaled_y).abs().sum(-1).reshape(shape) + slack
    high, low = plus * plus * 0.25, minus * minus * 0.25
    middle, half = 0.5 * (high - low), 0.5 * (high + low)
    larger, other = c.abs() * my, d.abs() * mx
    magnitude = larger + other + half + TINY  # |c| my >= |c d|, and half >= |middle|
    radius = half * SAFETY + magnitude * ((2 * error + 16 * UNIT) * SAFETY)
    center, coefficients = c * d + middle, c * gy + d * gx
    factors = Factors(gx, gy, ratio, plus, minus, radius_x, radius_y, middle, mx, my)
    frame.relaxations.append(
        Relaxed(
            "product",
            Band(ratio, middle, half),
            radius,
            frame.size,
            center,
            coefficients,
            magnitude,
            error,
            factors=factors,
        )
    )
    return AffineForm(frame, center, coefficients, magnitude, error).with_fresh(center, coefficients, magnitude, radius)


@handles(torch.nn.functional.linear)
def linear(x: AffineForm, weight: Tensor, bias: Tensor | None = None) -> AffineForm:
    """``x W^T + b``; one matrix product each for centre, coefficients and magnitude."""
    apply = torch.nn.functional.linear
    magnitude = apply(x.magnitude, weight.abs(), None if bias is None else bias.abs()) + TINY
    error = x.error + (weight.shape[-1] + 2) * UNIT
    return AffineForm(x.frame, apply(x.center, weight, bias), apply(x.coefficients, weight), magnitude, error)


@handles(torch.matmul, torch.Tensor.matmul, torch.Tensor.__matmul__)
def matrix_product(x: Any, y: Any) -> AffineForm:
    """``x @ W`` for a constant matrix."""
    if isinstance(y, AffineForm) or y.dim() != 2:
        raise UnsupportedOperationError("torch.matmul is supported as x @ W with a constant two-dimensional W")
    return linear(x, y.transpose(0, 1))


@handles(torch.sum, torch.Tensor.sum)
def total(x: AffineForm, dim: Any = None, keepdim: bool = False) -> AffineForm:
    """Sum over one event dimension."""
    if not isinstance(dim, int):
        raise UnsupportedOperationError(f"torch operation 'sum' is supported over one dimension, found dim={dim}")
    count = x.shape[dim]
    moved = x.moved_by(lambda t: t.sum(_from_end(dim, x), keepdim))
    return AffineForm(x.frame, moved.center, moved.coefficients, moved.magnitude, x.error + count * UNIT)


def _from_end(dim: int, x: AffineForm) -> int:
    """A dimension counted from the end, which is the same for values and for coefficients."""
    return dim if dim < 0 else dim - x.dim()


@handles(torch.stack)
def stack(values: Sequence[Any], dim: int = 0) -> AffineForm:
    """Stack forms and constants."""
    return _joined(torch.stack, values, dim if dim < 0 else dim - 1 - max(v.dim() for v in values))


@handles(torch.cat, torch.concat, torch.concatenate)
def cat(values: Sequence[Any], dim: int = 0) -> AffineForm:
    """Concatenate forms and constants."""
    return _joined(torch.cat, values, dim if dim < 0 else dim - max(v.dim() for v in values))


def _joined(join: Callable[..., Tensor], values: Sequence[Any], dim: int) -> AffineForm:
    frame = _frame_of(*values)
    size = max(v.coefficients.shape[0] for v in values if isinstance(v, AffineForm))
    error = max(v.error for v in values if isinstance(v, AffineForm))
    parts = []
    for v in values:
        if isinstance(v, AffineForm):
            shape = torch.Size((*frame.batch, *v.shape[len(frame.batch) :])) if v.dim() >= len(frame.batch) else v.shape
            parts.append(_expand(v, shape, size))
        else:
            value = torch.as_tensor(v, dtype=torch.float64)
            extra = value.dim() - (max(w.dim() for w in values) - len(frame.batch))
            if extra <= 0 and len(frame.batch):
                value = value.expand(*frame.batch, *value.shape)
            parts.append((value, value.new_zeros(size, *value.shape), value.abs() + TINY))
    centers, coefficients, magnitudes = zip(*parts, strict=True)
    return AffineForm(frame, join(centers, dim), join(coefficients, dim), join(magnitudes, dim), error)


@handles(torch.unbind, torch.Tensor.unbind)
def unbind(x: AffineForm, dim: int = 0) -> tuple[AffineForm, ...]:
    """Slices along one dimension."""
    d = _from_end(dim, x)
    return tuple(
        AffineForm(x.frame, c, g, m, x.error)
        for c, g, m in zip(x.center.unbind(d), x.coefficients.unbind(d), x.magnitude.unbind(d), strict=True)
    )


@handles(torch.flatten, torch.Tensor.flatten)
def flatten(x: AffineForm, start_dim: int = 0, end_dim: int = -1) -> AffineForm:
    """Merge event dimensions."""
    a, b = _from_end(start_dim, x), _from_end(end_dim, x)
    return x.moved_by(lambda t: t.flatten(a, b))


@handles(torch.unsqueeze, torch.Tensor.unsqueeze)
def unsqueeze(x: AffineForm, dim: int) -> AffineForm:
    """Insert a dimension."""
    d = dim if dim < 0 else dim - x.dim() - 1
    return x.moved_by(lambda t: t.unsqueeze(d))


@handles(torch.squeeze, torch.Tensor.squeeze)
def squeeze(x: AffineForm, dim: int) -> AffineForm:
    """Remove a dimension of size one."""
    return x.moved_by(lambda t: t.squeeze(_from_end(dim, x)))
