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

from sagemp_cli.errors import UnsupportedOperationError, UsageError
from sagemp_cli.reachability.form import ANGLE, Form, Operation
from sagemp_cli.reachability.recording import recorded_bands
from sagemp_cli.reachability.relaxations import arctangent2 as _arctangent2
from sagemp_cli.reachability.relaxations.arctangent2 import Turn
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
        given: what else the lines depend on, after the bounds: tensors in the input's shape.
        turn: of an angle, the direction across which its input is (:mod:`.relaxations.arctangent2`).
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
    given: tuple[Tensor, ...] = ()
    turn: Turn | None = None


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


class Hint(NamedTuple):
    """What is known from an earlier pass of one operation's input.

    Attributes:
        name, size: of the operation that it is known of, and of one cell's entries.
        lower, upper: bounds of the input; None if there are none.
        turn: of an angle, the direction across which its input was.
    """

    name: str
    size: int
    lower: Tensor | None = None
    upper: Tensor | None = None
    turn: Turn | None = None

    def intersected(self, other: Hint) -> Hint:
        """What holds if both hold; the other one, if they are not of the same input."""
        same_turn = all(map(torch.equal, self.turn or (), other.turn or ())) and (not self.turn) == (not other.turn)
        if self.lower is None or self[:2] != other[:2] or not same_turn:
            return other
        if other.lower is None:
            return self
        return self._replace(lower=torch.maximum(self.lower, other.lower), upper=torch.minimum(self.upper, other.upper))


Hints = Sequence[Hint]
"""What is known of every operation of a step, in the order of evaluation."""


def hint_of(hints: Hints | None, name: str, size: int, before: Sequence[tuple[str, int]]) -> Hint | None:
    """What is known of the operation that comes after these.

    Raises:
        UsageError: the step does other operations than when the hints were found: they may be bounds of other values.
    """
    if hints is None:
        return None
    now, then = [*before, (name, size)], [(h.name, h.size) for h in hints[: len(before) + 1]]
    if now != then:
        found, was = (", ".join(f"{n} of {s}" for n, s in names) for names in (now, then))
        raise UsageError(
            f"the loop's step does not always do the same operations: {found}, where it did {was} in an earlier pass"
        )
    return hints[len(before)]


def narrowed(lower: Tensor, upper: Tensor, hint: Hint | None) -> tuple[Tensor, Tensor]:
    """Bounds of an operation's input, intersected with what is known of it."""
    if hint is None or hint.lower is None or hint.upper is None:
        return lower, upper
    return torch.maximum(lower, hint.lower), torch.minimum(upper, hint.upper)


class StepFrame:
    """The variables of one step: the state set's generators, the disturbance box, and the relaxation errors so far.

    Attributes:
        generators: ``G (*batch, n, M)``.
        reach: an upper bound of ``|z_i|`` for states, ``(*batch, n)``.
        disturbance_radius: of the disturbance variables, ``(d,)``.
        size: number of variables so far.
        relaxations: the nonlinear operations of this step, in the order of evaluation.
        hints: what is known of them; bounds of their inputs are intersected with what the forms give.
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
        """Names and bands of the operations, in the order of evaluation, and directions of angles."""
        return [pair for r in self.relaxations for pair in recorded_bands(r.name, r.band, r.turn)]

    def hint(self, name: str, shape: torch.Size) -> Hint | None:
        """What is known of the next operation."""
        if self.hints is None:
            return None
        return hint_of(
            self.hints, name, self.entries(shape), [(r.name, self.entries(r.center.shape)) for r in self.relaxations]
        )

    def entries(self, shape: torch.Size) -> int:
        """Entries of one cell."""
        return math.prod(shape[len(self.batch) :])

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
        lower, upper = narrowed(*self.bounds(), self.frame.hint(name, self.shape))
        band = operation.band(lower, upper, *parameters)
        return self.within(name, band, lower=lower, upper=upper, operation=operation, parameters=parameters)

    def angle(self, x: AffineForm) -> AffineForm:
        """The form of ``atan2(self, x)``: a function of how far the point is across the middle of its angles."""
        hint = self.frame.hint("atan2", self.shape)
        low, high = ANGLE.value_range(*self.bounds(), *x.bounds())
        turn = _arctangent2.turn(low, high) if hint is None or hint.turn is None else hint.turn
        across, along = self * turn.cosine - x * turn.sine, x * turn.cosine + self * turn.sine
        lower, upper = narrowed(*across.bounds(), hint)
        radius = along.radius()
        scale = torch.sqrt(radius / across.radius()).detach()
        x, y = across * scale, along / scale
        ends = [form.radius() + form.slack() for form in (x + y, x - y)]
        twist = _arctangent2.twist(across.center, radius, *ends)
        given = (*along.bounds(), along.center, *twist, turn.angle, low, high)
        band = ANGLE.band(lower, upper, *given)
        return across.within("atan2", band, lower=lower, upper=upper, operation=ANGLE, given=given, turn=turn)

    def within(self, name: str, band: Band, **made_of: Any) -> AffineForm:
        """The form of ``slope * self + offset + [-radius, radius]``; ``made_of`` are attributes of :class:`Relaxed`."""
        frame = self.frame
        slope, offset, radius = band
        magnitude = slope.abs() * self.magnitude + offset.abs() + (radius + TINY)
        radius = radius * SAFETY + magnitude * ((self.error + 4 * UNIT) * SAFETY)
        frame.relaxations.append(
            Relaxed(
                name, band, radius, frame.size, self.center, self.coefficients, self.magnitude, self.error, **made_of
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
