"""The values and the nonlinear operations of a step on arrays.

The counterpart, cells first, of :class:`~sagemp_cli.reachability.affine.form.StepFrame` and of the operations of
:mod:`~.affine.operations`; :mod:`~sagemp_cli.reachability.affine.compiled.run` puts them together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from sagemp_cli.reachability.affine.compiled.folding import Node
from sagemp_cli.reachability.affine.form import SAFETY, Hint, Hints, hint_of
from sagemp_cli.reachability.relaxations import arctangent2 as _arctangent2
from sagemp_cli.reachability.relaxations.arctangent2 import Turn
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.functions import on_tensors
from sagemp_cli.reachability.relaxations.sine import sine_and_cosine_bands
from sagemp_cli.sets.rounding import TINY, UNIT

Array = np.ndarray


class Value(NamedTuple):
    """A vector in the form of :mod:`~sagemp_cli.reachability.affine.form`, cells first.

    Attributes:
        both: centre and magnitude, ``(2, B, e)``.
        coefficients: ``(B, e, variables)``, or for all cells ``(1, e, variables)``.
        error: relative rounding error.
    """

    both: Array
    coefficients: Array
    error: float


class Record(NamedTuple):
    """A nonlinear operation as :class:`~sagemp_cli.reachability.affine.form.Relaxed` describes it."""

    name: str
    band: Band
    radius: Array
    first: int
    form: Value
    lower: Array | None = None
    upper: Array | None = None
    node: Node | None = None
    factors: tuple[Array, ...] = ()
    given: tuple[Array, ...] = ()
    turn: Turn | None = None


class States:
    """The state set before a step, and the variables of the step so far: the array's counterpart of
    :class:`~sagemp_cli.reachability.affine.form.StepFrame`.

    Args:
        center, reach: of the set, ``(B, n)``; reach is an upper bound of its radius.
        generators: ``(B, n, M)``.
        inputs: how many states and disturbances there are.
        own_radius: radii of all variables that a step has but the states.
        hints: what is known of the operations.
    """

    def __init__(
        self,
        center: Array,
        reach: Array,
        generators: Array,
        *,
        inputs: int,
        own_radius: Array,
        hints: Hints | None = None,
    ) -> None:
        self.both = np.array([center, np.abs(center) + reach + TINY])
        self.reach, self.generators, self.hints = reach, generators, hints
        self.own_radius = own_radius
        self.size = inputs
        self.records: list[Record] = []

    @property
    def sum_error(self) -> float:
        """Relative error of sums over all symbols and of the products with the generators."""
        return 2 * (self.generators.shape[-1] + self.size + 64) * UNIT

    def rows(self, coefficients: Array, extra: int = 0) -> Array:
        """A vector in terms of all symbols, ``(B, e, symbols)``, with so many more columns of zeros."""
        n, count = self.generators.shape[-2:]
        own = coefficients.shape[-1] - n
        rows = np.empty((len(self.generators), coefficients.shape[-2], count + own + extra))
        np.matmul(coefficients[..., :n], self.generators, out=rows[..., :count])
        if own:
            np.multiply(coefficients[..., n:], self.own_radius[:own], out=rows[..., count : count + own])
        if extra:
            rows[..., count + own :] = 0.0
        return rows

    def radius(self, coefficients: Array) -> Array:
        """Sums of the magnitudes of a vector's coefficients over all symbols, ``(B, e)``, but for rounding.

        In blocks of symbols that stay in the processor's cache.
        """
        n, count = self.generators.shape[-2:]
        of_state, own = coefficients[..., :n], coefficients[..., n:]
        radius = np.abs(own) @ self.own_radius[: own.shape[-1]]
        block = max(_BLOCK // (len(self.generators) * coefficients.shape[-2]), 64)
        for first in range(0, count, block):
            part = of_state @ self.generators[..., first : first + block]
            radius = radius + np.abs(part, out=part) @ _ONES[: part.shape[-1]]
        return radius

    def bounds(self, x: Value) -> tuple[Array, Array]:
        """Lower and upper bounds, rounding included."""
        radius = self.radius(x.coefficients) + x.both[1] * ((x.error + self.sum_error) * SAFETY)
        return x.both[0] - radius, x.both[0] + radius

    def hint(self, name: str, size: int, after: Sequence[tuple[str, int]] = ()) -> Hint | None:
        """What is known of the next operation, or of the one that comes after these."""
        if self.hints is None:
            return None
        return hint_of(self.hints, name, size, [*((r.name, r.radius.shape[-1]) for r in self.records), *after])

    def result(self, record: Record, center: Array, magnitude: Array, coefficients: Array, factor: Array) -> Value:
        """Note an operation: ``center + factor coefficients``, and a new variable of the record's radius per entry."""
        self.records.append(record)
        radius, size = record.radius, record.radius.shape[-1]
        out = np.zeros((len(self.generators), size, self.size + size))
        np.multiply(coefficients, factor, out=out[..., : coefficients.shape[-1]])
        diagonal(out, self.size)[...] = radius
        self.size += size
        return Value(np.array([center, magnitude + radius]), out, 4 * UNIT)


def diagonal(rows: Array, first: int) -> Array:
    """The entries ``(i, first + i)`` of contiguous matrices ``(B, e, first + e)``, to be written."""
    cells, size, width = rows.shape
    return rows.reshape(cells, size * width)[:, first :: width + 1]


class Bounded(NamedTuple):
    """The operand of a function: its form, its bounds, the function's band over them, and of an angle more."""

    form: Value
    lower: Array
    upper: Array
    band: Band
    given: tuple[Array, ...] = ()
    turn: Turn | None = None


def _narrowed(lower: Array, upper: Array, hint: Hint | None) -> tuple[Array, Array]:
    """Bounds of an operation's input, intersected with what is known of it."""
    if hint is None or hint.lower is None or hint.upper is None:
        return lower, upper
    return (
        np.maximum(lower, hint.lower.reshape(lower.shape).numpy()),
        np.minimum(upper, hint.upper.reshape(upper.shape).numpy()),
    )


def _scalar(node: Node, states: States, x: Value) -> Value:
    """A function of one variable: its band over the operand's bounds."""
    lower, upper = _narrowed(*states.bounds(x), states.hint(node.name, node.size))
    assert node.operation is not None
    band = node.operation.band_of_arrays(lower, upper, *node.parameters)
    return enclosed(node, states, Bounded(x, lower, upper, band))


def sine_and_cosine_operands(node: Node, states: States, x: Value) -> tuple[Bounded, Bounded]:
    """Of a sine and the cosine that follows it, or the other way round."""
    bounds, other = states.bounds(x), "cos" if node.name == "sin" else "sin"
    hints = states.hint(node.name, node.size), states.hint(other, node.size, [(node.name, node.size)])
    both = [_narrowed(*bounds, hint) for hint in hints]
    order = 1 if node.name == "sin" else -1
    lower, upper = (np.array(side) for side in zip(*both[::order], strict=True))
    bands = sine_and_cosine_bands(lower, upper)[::order]
    first, second = (Bounded(x, *sides, band) for sides, band in zip(both, bands, strict=True))
    return first, second


def enclosed(node: Node, states: States, operand: Bounded) -> Value:
    """A function's result, within its band."""
    x, lower, upper, band, given, turn = operand
    slope, offset, radius = band
    magnitude = np.abs(slope) * x.both[1] + np.abs(offset) + (radius + TINY)
    radius = radius * SAFETY + magnitude * ((x.error + 4 * UNIT) * SAFETY)
    record = Record(node.name, band, radius, states.size, x, lower, upper, node, given=given, turn=turn)
    return states.result(record, x.both[0] * slope + offset, magnitude, x.coefficients, slope[..., None])


def _product(node: Node, states: States, operands: Value) -> Value:
    """The product of the first half of the entries and the second.

    ``(c + X)(d + Y) = c d + c Y + d X + X Y`` and ``X Y = (P^2 - M^2) / 4``: see ``_product`` of
    :mod:`~sagemp_cli.reachability.affine.operations`, which this is for arrays.
    """
    size, error = node.size, operands.error
    gx, gy = operands.coefficients[:, :size], operands.coefficients[:, size:]
    # Rounding of the sums, and of scaling (3 more units) is within twice the usual slack.
    slack = operands.both[1] * (2 * (error + states.sum_error) * SAFETY)
    radius = states.radius(operands.coefficients) + slack
    radius_x, radius_y = radius[:, :size], radius[:, size:]
    ratio = np.sqrt(radius_y / radius_x)
    x, y = gx * ratio[..., None], gy / ratio[..., None]
    doubt = (slack[:, :size] * ratio + slack[:, size:] / ratio) * SAFETY
    ends = states.radius(np.concatenate([x + y, x - y], axis=-2))
    plus, minus = ends[:, :size] + doubt, ends[:, size:] + doubt
    high, low = plus * plus * 0.25, minus * minus * 0.25
    middle, half = 0.5 * (high - low), 0.5 * (high + low)
    (c, mx), (d, my) = operands.both[..., :size], operands.both[..., size:]
    magnitude = np.abs(c) * my + np.abs(d) * mx + half + TINY  # |c| my >= |c d|, and half >= |middle|
    center, coefficients = c * d + middle, c[..., None] * gy + d[..., None] * gx
    record = Record(
        "product",
        Band(ratio, middle, half),
        half * SAFETY + magnitude * ((2 * error + 16 * UNIT) * SAFETY),
        states.size,
        Value(np.array([center, magnitude]), coefficients, error),
        factors=(gx, gy, ratio, plus, minus, radius_x, radius_y, middle, mx, my),
    )
    return states.result(record, center, magnitude, coefficients, _ONE)


def _quotient(node: Node, states: States, operands: Value) -> Value:
    """``a / b = q + (a - q b) (1 / b)`` for any q: near the centres' quotient what the two share cancels before."""
    size = node.size
    (a, size_a), (b, size_b), reciprocal = (operands.both[..., i * size : (i + 1) * size] for i in range(3))
    of_a, of_b, rest = (operands.coefficients[:, i * size : (i + 1) * size] for i in range(3))
    q = np.nan_to_num(a / b, nan=0.0, posinf=0.0, neginf=0.0)
    difference = np.array([a - q * b, size_a + np.abs(q) * size_b + TINY])
    factors = Value(
        np.concatenate([difference, reciprocal], axis=-1),
        np.concatenate([of_a - q[..., None] * of_b, rest], axis=-2),
        operands.error + 2 * UNIT,
    )
    product = _product(node, states, factors)
    return Value(product.both + np.array([q, np.abs(q)]), product.coefficients, product.error + 2 * UNIT)


def _angle(node: Node, states: States, operands: Value) -> Value:
    """The angle of a point, of its distance across a direction in the middle of its angles."""
    assert node.operation is not None
    size, hint = node.size, states.hint(node.name, node.size)
    lower, upper = states.bounds(operands)
    low, high = on_tensors(
        _arctangent2.value_range,
        *(
            np.ascontiguousarray(a)
            for side in (slice(size), slice(size, None))
            for a in (lower[:, side], upper[:, side])
        ),
    )
    if hint is None or hint.turn is None:
        turn = on_tensors(_arctangent2.turn, low, high)
    else:
        turn = Turn(*(part.reshape(low.shape).numpy() for part in hint.turn))
    c, s, angle = turn
    (y, size_y), (x, size_x) = operands.both[..., :size], operands.both[..., size:]
    gy, gx = operands.coefficients[:, :size], operands.coefficients[:, size:]
    magnitude = [np.abs(c) * size_y + np.abs(s) * size_x + TINY, np.abs(c) * size_x + np.abs(s) * size_y + TINY]
    turned = Value(
        np.concatenate([np.array([c * y - s * x, magnitude[0]]), np.array([c * x + s * y, magnitude[1]])], axis=-1),
        np.concatenate([c[..., None] * gy - s[..., None] * gx, c[..., None] * gx + s[..., None] * gy], axis=-2),
        operands.error + 2 * UNIT,
    )
    lower, upper = states.bounds(turned)
    radius = states.radius(turned.coefficients) + turned.both[1] * ((turned.error + states.sum_error) * SAFETY)
    ratio = np.sqrt(radius[:, size:] / radius[:, :size])
    v, u = turned.coefficients[:, :size] * ratio[..., None], turned.coefficients[:, size:] / ratio[..., None]
    # Rounding of the sums, and of scaling (3 more units each) is within twice the usual slack.
    slack = turned.both[1] * (2 * (turned.error + states.sum_error) * SAFETY)
    doubt = (slack[:, :size] * ratio + slack[:, size:] / ratio) * SAFETY
    ends = states.radius(np.concatenate([v + u, v - u], axis=-2))
    (center, middle), bounds = np.split(turned.both[0], 2, axis=-1), (lower[:, size:], upper[:, size:])
    twist = _arctangent2.twist(center, radius[:, size:], ends[:, :size] + doubt, ends[:, size:] + doubt)
    given = (*bounds, middle, *twist, angle, low, high)
    across = Value(turned.both[..., :size], turned.coefficients[:, :size], turned.error)
    lower, upper = _narrowed(lower[:, :size], upper[:, :size], hint)
    band = node.operation.band_of_arrays(lower, upper, *given)
    return enclosed(node, states, Bounded(across, lower, upper, band, given, turn))


_BLOCK = 2**16
"""Entries of an array that stays in the cache."""
_ONES = np.ones(_BLOCK)
_ONE = np.ones(1)
EVALUATE: dict[str, Callable[[Node, States, Value], Value]] = {
    "scalar": _scalar,
    "product": _product,
    "quotient": _quotient,
    "angle": _angle,
}
