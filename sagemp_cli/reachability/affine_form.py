"""Affine forms: values that answer torch's operations and carry what they depend on.

Within one step of a loop a value is enclosed as ::

    y in c + sum_i coefficient_i z_i + [-e, e],        e = error * magnitude

where the variables ``z`` are, in this order, the deviations of the state from the centre of the current
state set (a zonotope ``z_x = G eps``), the deviations of the disturbance (a box), and the relaxation errors of
this step (each in [-1, 1]). Linear operations act on the centre and on the coefficients alike; a nonlinear one
is replaced by a band and adds one variable per entry.

Rounding. ``magnitude`` obeys the same recurrences with absolute values, ``|c| + sum_i |coefficient_i| |z_i|``;
then after any sequence of linear operations the accumulated rounding error is at most ``error * magnitude``
with ``error`` the sum of the unit roundoffs along the longest path (each operation adds its own
``gamma_k = k u``, Higham 2002, section 3.1). A relaxation absorbs the error of its input in its own radius and
starts again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sagemp_cli.errors import UnsupportedOperationError
from sagemp_cli.reachability.form import Form, Operation, registers
from sagemp_cli.reachability.relaxations.band import TINY, UNIT, Band

_SAFETY = 1.0 + 1e-9  # covers the rounding made in computing magnitudes and error factors themselves


class Relaxed(NamedTuple):
    """One nonlinear operation of a step, as the forward pass met it: all that a backward pass needs (tensors only, no
    cycle).

    Attributes:
        name: of the operation.
        band: the one used.
        radius: of the variables it added, rounding included: the band's error is ``radius * z``, ``(*batch, ...)``.
        first: index of the first of them.
        center, coefficients, magnitude, error: the input's form.
        lower, upper: the input's bounds that the band was made for (None for a product, which has a band of its own).
        operation, parameters: how to get lines for those bounds; None for a product and where there is nothing but the
            band.
        factors: of a product.
    """

    name: str
    band: Band
    radius: Tensor
    first: int
    center: Tensor
    coefficients: Tensor
    magnitude: Tensor
    error: float
    lower: Tensor | None = None
    upper: Tensor | None = None
    operation: Operation | None = None
    parameters: tuple[Any, ...] = ()
    factors: Factors | None = None


class Factors(NamedTuple):
    """The deviations X and Y of a product's factors, as ``P = l X + Y / l`` and ``M = l X - Y / l``:
    ``X Y = (P^2 - M^2) / 4``.

    Attributes:
        x, y: coefficients of X and Y, ``(variables, *batch, ...)``.
        scale: l.
        plus, minus: bounds of ``|P|`` and ``|M|``, rounding included.
        radius_x, radius_y: of ``|X|`` and ``|Y|``.
        middle: what the product's form counts of ``X Y`` itself; the rest is its error.
        magnitude_x, magnitude_y: of the factors.
    """

    x: Tensor
    y: Tensor
    scale: Tensor
    plus: Tensor
    minus: Tensor
    radius_x: Tensor
    radius_y: Tensor
    middle: Tensor
    magnitude_x: Tensor
    magnitude_y: Tensor

    @property
    def sum(self) -> Tensor:
        """Coefficients of P."""
        return self.x * self.scale + self.y / self.scale

    @property
    def difference(self) -> Tensor:
        """Coefficients of M."""
        return self.x * self.scale - self.y / self.scale

    @property
    def size(self) -> Tensor:
        """Bound of ``|l X|`` and ``|Y / l|``, rounding included."""
        return torch.maximum(self.radius_x * self.scale, self.radius_y / self.scale) * _SAFETY

    @property
    def magnitude(self) -> Tensor:
        """Of ``l X`` and ``Y / l`` together."""
        return self.magnitude_x * self.scale + self.magnitude_y / self.scale


Hints = Sequence[tuple[Tensor, Tensor] | None]
"""Bounds known from elsewhere of each operation's input, in the order of evaluation."""


class StepFrame:
    """The variables of one step: the state set's generators, the disturbance box, and the relaxation errors so far.

    Attributes:
        generators: ``G (*batch, n, M)``.
        reach: an upper bound of ``|z_i|`` for states, ``(*batch, n)``.
        disturbance_radius: of the disturbance variables, ``(d,)``.
        size: number of variables so far.
        relaxations: the nonlinear operations of this step, in the order of evaluation.
        hints: bounds of their inputs, intersected with what the forms give.
        ellipsoid: after :meth:`condense`, the shape matrix of the symbols, scaled to the extent of the set's box,
            ``(*batch, n, n)``; no enclosure, but enough where a guess is.
    """

    def __init__(
        self, generators: Tensor, reach: Tensor, disturbance_radius: Tensor, *, hints: Hints | None = None
    ) -> None:
        self.generators = generators
        self.reach = reach
        self.disturbance_radius = disturbance_radius
        self._own_radius = torch.cat([disturbance_radius, disturbance_radius.new_ones(64)])
        self.states = generators.shape[-2]
        self.inputs = self.states + disturbance_radius.shape[-1]
        self.size = self.inputs
        self.batch = generators.shape[:-2]
        self.relaxations: list[Relaxed] = []
        self.hints = hints
        self.ellipsoid: Tensor | None = None

    @property
    def bands(self) -> list[tuple[str, Band]]:
        """Names and bands of the operations, in the order of evaluation."""
        return [(r.name, r.band) for r in self.relaxations]

    def narrowed(self, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
        """The bounds of the next operation's input, intersected with what is known of it."""
        hint = None if self.hints is None else self.hints[len(self.relaxations)]
        return (lower, upper) if hint is None else (torch.maximum(lower, hint[0]), torch.minimum(upper, hint[1]))

    @property
    def sum_error(self) -> float:
        """Relative error (gamma) of sums over all symbols and of the products with the generators."""
        return 2 * (self.generators.shape[-1] + self.size + 64) * UNIT

    def condense(self) -> None:
        """Give up the generators, most of a kept step, for an ellipsoid: no forms are made after this."""
        square = self.generators @ self.generators.mT
        scale = self.reach / (square.diagonal(dim1=-2, dim2=-1).sqrt() + TINY)
        self.ellipsoid = square * scale[..., None] * scale[..., None, :]
        self.generators = self.generators[..., :0].clone()

    def own_radius(self, count: int) -> Tensor:
        """Radii of the first ``count`` variables after the state: the disturbance's, then ones."""
        if count > self._own_radius.shape[0]:
            more = max(count - self._own_radius.shape[0], 64)
            self._own_radius = torch.cat([self._own_radius, self._own_radius.new_ones(more)])
        return self._own_radius[:count]

    def state(self, center: Tensor) -> AffineForm:
        """The current state as a form."""
        return AffineForm(self, center, self._unit(0, self.states, center), center.abs() + self.reach + TINY, 0.0)

    def disturbance(self, center: Tensor) -> AffineForm:
        """The current disturbance as a form."""
        shape = (*self.batch, self.inputs - self.states)
        magnitude = (center.abs() + self.disturbance_radius + TINY).expand(shape)
        return AffineForm(self, center.expand(shape), self._unit(self.states, self.inputs, center), magnitude, 0.0)

    def _unit(self, first: int, last: int, like: Tensor) -> Tensor:
        """Coefficients of the variables ``first..last-1`` themselves."""
        unit = torch.eye(self.inputs, dtype=like.dtype, device=like.device)[:, first:last]
        shape = (self.inputs, *self.batch, last - first)
        return unit.reshape(self.inputs, *[1] * len(self.batch), last - first).expand(shape)


class AffineForm(Form):
    """An enclosed value of shape ``shape``; see the module."""

    __slots__ = ("_bounds", "_spread", "center", "coefficients", "error", "frame", "magnitude")

    def __init__(self, frame: StepFrame, center: Tensor, coefficients: Tensor, magnitude: Tensor, error: float) -> None:
        self.frame = frame
        self.center = center
        self.coefficients = coefficients
        self.magnitude = magnitude
        self.error = error
        self._bounds: tuple[Tensor, Tensor] | None = None  # kept: one value often goes into several operations
        self._spread: Tensor | None = None

    # -- reading -------------------------------------------------------------------------------------------------

    @property
    def shape(self) -> torch.Size:
        """Shape, batch first."""
        return self.center.shape

    def dim(self) -> int:
        """Number of dimensions."""
        return self.center.dim()

    @property
    def dtype(self) -> torch.dtype:
        """Always float64."""
        return self.center.dtype

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
        return self.center.device

    def spread(self) -> Tensor:
        """Rows ``(*batch, events, symbols)`` of the form in terms of all symbols in [-1, 1] (without the error part).

        The entries carry a relative rounding that :meth:`radius` accounts for.
        """
        if self._spread is None:
            frame, rows = self.frame, self._rows()
            n = frame.states
            own = rows[..., n:] * frame.own_radius(rows.shape[-1] - n)
            self._spread = torch.cat([rows[..., :n] @ frame.generators, own], dim=-1)
        return self._spread

    def _rows(self) -> Tensor:
        """Coefficients as ``(*batch, events, variables)``."""
        coefficients, batch = self.coefficients, self.frame.batch
        if self.center.shape[: len(batch)] != batch:
            raise UnsupportedOperationError(
                f"a value of shape {tuple(self.shape)} has lost the batch dimensions {tuple(batch)}; "
                f"index, sum and flatten from the end, as in x[..., 0]"
            )
        if coefficients.dim() != len(batch) + 2:
            coefficients = coefficients.reshape(coefficients.shape[0], *batch, -1)
        return coefficients.movedim(0, -1)

    def rounding(self) -> Tensor:
        """Upper bound of the rounding error carried, plus that of :meth:`spread`."""
        return self.magnitude * ((self.error + (2 * self.frame.states + 16) * UNIT) * _SAFETY)

    def slack(self) -> Tensor:
        """Upper bound of the rounding error carried, plus that of summing up a radius and of one subtraction."""
        return self.magnitude * ((self.error + self.frame.sum_error) * _SAFETY)

    def radius(self) -> Tensor:
        """An upper bound of ``|y - c|``, rounding included, such that ``c - r`` and ``c + r`` as rounded are bounds."""
        frame = self.frame
        rows = self._rows()
        n = frame.states
        own = (rows[..., n:].abs() * frame.own_radius(rows.shape[-1] - n)).sum(-1)
        total = (rows[..., :n] @ frame.generators).abs().sum(-1) + own
        return total.reshape(self.shape) + self.slack()

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper bound of the value."""
        if self._bounds is None:
            r = self.radius()
            self._bounds = self.center - r, self.center + r
        return self._bounds

    # -- building ------------------------------------------------------------------------------------------------

    def _linear(
        self, map_: Callable[[Tensor], Tensor], coefficient_map: Callable[[Tensor], Tensor] | None = None
    ) -> AffineForm:
        """A form under a map that only moves entries (exact)."""
        return AffineForm(
            self.frame,
            map_(self.center),
            (coefficient_map or map_)(self.coefficients),
            map_(self.magnitude),
            self.error,
        )

    def relaxed(self, name: str, operation: Operation, *parameters: Any) -> AffineForm:
        """The form of ``f(self)``: f's band over :meth:`bounds`."""
        lower, upper = self.frame.narrowed(*self.bounds())
        return self._within(name, operation.band(lower, upper, *parameters), lower, upper, operation, parameters)

    def widened(self, name: str, band: Band) -> AffineForm:
        """The form of ``slope * self + offset + [-radius, radius]``."""
        return self._within(name, band)

    def _within(self, name: str, band: Band, *made_of: Any) -> AffineForm:
        frame = self.frame
        slope, offset, radius = band
        magnitude = slope.abs() * self.magnitude + offset.abs() + (radius + TINY)
        radius = radius * _SAFETY + magnitude * ((self.error + 4 * UNIT) * _SAFETY)
        frame.relaxations.append(
            Relaxed(
                name, band, radius, frame.size, self.center, self.coefficients, self.magnitude, self.error, *made_of
            )
        )
        return self._with_fresh(self.center * slope + offset, self.coefficients * slope, magnitude, radius)

    def _with_fresh(self, center: Tensor, coefficients: Tensor, magnitude: Tensor, radius: Tensor) -> AffineForm:
        """Append one new variable per entry with the given radius."""
        frame = self.frame
        batch = len(frame.batch)
        events = math.prod(center.shape[batch:])
        fresh = center.new_zeros(frame.size - coefficients.shape[0] + events, *center.shape)
        if center.dim() == batch:
            fresh[-1] = radius
        else:
            flat = fresh[-events:].flatten(batch + 1)
            flat.diagonal(dim1=0, dim2=-1).copy_(radius.flatten(batch))
        frame.size += events
        return AffineForm(frame, center, torch.cat([coefficients, fresh]), magnitude + radius, 4 * UNIT)

    def __getitem__(self, index: Any) -> AffineForm:
        index = index if isinstance(index, tuple) else (index,)
        return self._linear(lambda t: t[index], lambda t: t[(slice(None), *index)])


HANDLERS: dict[Any, Callable[..., Any]] = {}
"""Torch function to its implementation on affine forms; one line per function."""

AffineForm.handlers = HANDLERS
handles = registers(HANDLERS)


def _frame_of(*values: Any) -> StepFrame:
    return next(v.frame for v in values if isinstance(v, AffineForm))


def constant(frame: StepFrame, value: Any, like: Tensor) -> Tensor:
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
        b = multiply(b, alpha) if isinstance(b, AffineForm) else b * alpha
    if not isinstance(a, AffineForm):
        a, b = b, a
    if not isinstance(b, AffineForm):
        value = constant(a.frame, b, a.center)
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
    return add(a, multiply(b, -alpha) if isinstance(b, AffineForm) else -b * alpha)


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
    value = constant(a.frame, b, a.center)
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
    value = constant(a.frame, b, a.center)
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
    share = 2 * (error + frame.sum_error) * _SAFETY
    slack_x, slack_y = mx * share, my * share
    with torch.no_grad():
        radius_x = rows_x.abs().sum(-1).reshape(shape) + slack_x
        radius_y = rows_y.abs().sum(-1).reshape(shape) + slack_y
        ratio = torch.sqrt(radius_y / radius_x)
    scale = ratio.reshape(rows_x.shape[:-1])[..., None]
    scaled_x, scaled_y = rows_x * scale, rows_y / scale
    slack = (slack_x * ratio + slack_y / ratio) * _SAFETY
    plus = (scaled_x + scaled_y).abs().sum(-1).reshape(shape) + slack
    minus = (scaled_x - scaled_y).abs().sum(-1).reshape(shape) + slack
    high, low = plus * plus * 0.25, minus * minus * 0.25
    middle, half = 0.5 * (high - low), 0.5 * (high + low)
    larger, other = c.abs() * my, d.abs() * mx
    magnitude = larger + other + half + TINY  # |c| my >= |c d|, and half >= |middle|
    radius = half * _SAFETY + magnitude * ((2 * error + 16 * UNIT) * _SAFETY)
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
    return AffineForm(frame, center, coefficients, magnitude, error)._with_fresh(
        center, coefficients, magnitude, radius
    )


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
    moved = x._linear(lambda t: t.sum(_from_end(dim, x), keepdim))
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
    return x._linear(lambda t: t.flatten(a, b))


@handles(torch.unsqueeze, torch.Tensor.unsqueeze)
def unsqueeze(x: AffineForm, dim: int) -> AffineForm:
    """Insert a dimension."""
    d = dim if dim < 0 else dim - x.dim() - 1
    return x._linear(lambda t: t.unsqueeze(d))


@handles(torch.squeeze, torch.Tensor.squeeze)
def squeeze(x: AffineForm, dim: int) -> AffineForm:
    """Remove a dimension of size one."""
    return x._linear(lambda t: t.squeeze(_from_end(dim, x)))
