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
from sagemp_cli.reachability.form import Form, Operation
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.sets.rounding import TINY, UNIT

SAFETY = 1.0 + 1e-9  # covers the rounding made in computing magnitudes and error factors themselves


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
        return torch.maximum(self.radius_x * self.scale, self.radius_y / self.scale) * SAFETY

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
        return self.magnitude * ((self.error + (2 * self.frame.states + 16) * UNIT) * SAFETY)

    def slack(self) -> Tensor:
        """Upper bound of the rounding error carried, plus that of summing up a radius and of one subtraction."""
        return self.magnitude * ((self.error + self.frame.sum_error) * SAFETY)

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

    def moved_by(
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
        radius = radius * SAFETY + magnitude * ((self.error + 4 * UNIT) * SAFETY)
        frame.relaxations.append(
            Relaxed(
                name, band, radius, frame.size, self.center, self.coefficients, self.magnitude, self.error, *made_of
            )
        )
        return self.with_fresh(self.center * slope + offset, self.coefficients * slope, magnitude, radius)

    def with_fresh(self, center: Tensor, coefficients: Tensor, magnitude: Tensor, radius: Tensor) -> AffineForm:
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
        return self.moved_by(lambda t: t[index], lambda t: t[(slice(None), *index)])
