"""The affine rules: values of a step as forms of what they depend on, and what a nonlinear operation makes of them.

Within one step a value is enclosed as ::

    y in c + sum_i coefficient_i z_i + [-e, e],        e = error * magnitude

where the variables ``z`` are, in this order, the deviations of the state from the centre of the current set (a zonotope
``z_x = G eps``), the deviations of the disturbance (a box), and the relaxation errors of this step, one per entry of
each nonlinear operation. ``magnitude`` obeys the same recurrences as the value with absolute values, so that rounding
is at most ``error`` times it (:mod:`sagemp_cli.sets.rounding`). A nonlinear operation is replaced by a band; it takes
the rounding of its input into its own radius and starts again.

Everything is written once, for numpy's arrays, whose operations on a few numbers cost a fifth of torch's, and for
tensors, through which a tube is differentiated. It is one long file because all rules share the account of rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from sagemp_cli.reachability.affine.compiled.arrays import added, like, widened, with_fresh
from sagemp_cli.reachability.affine.compiled.beside import ONE_KINK, Beside
from sagemp_cli.reachability.affine.compiled.folding import Node
from sagemp_cli.reachability.affine.compiled.hints import Hint, Hints, hint_of
from sagemp_cli.reachability.relaxations import arctangent2 as _arctangent2
from sagemp_cli.reachability.relaxations import choice as _choices
from sagemp_cli.reachability.relaxations.arctangent2 import Turn
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.float32 import error_of_sums, sizes_of_sums
from sagemp_cli.reachability.relaxations.functions import constant, contiguous, functions_of, on_tensors
from sagemp_cli.reachability.relaxations.sine import sine_and_cosine_bands
from sagemp_cli.sets.rounding import BAND, ROUNDED, SAFETY, SHIFT, SUM, TINY, of_generators, of_product, over_symbols
from sagemp_cli.sets.zonotope import Zonotope

Array = Any  # of numpy or of torch, which have no type in common: functions_of does the same to both


class Value(NamedTuple):
    """A vector as forms, cells first.

    Attributes:
        both: centre and magnitude, ``(2, B, e)``.
        coefficients: ``(B, e, variables)``, or for all cells ``(1, e, variables)``.
        error: relative rounding error.
        fresh: of the last e variables, of which each entry has one of its own, the coefficients, ``(B, e)``; None if it
            is not so.
    """

    both: Array
    coefficients: Array
    error: float
    fresh: Array | None = None


class Factors(NamedTuple):
    """The deviations X and Y of a product's factors, as ``P = l X + Y / l`` and ``M = l X - Y / l``:
    ``X Y = (P^2 - M^2) / 4``.

    Attributes:
        x, y: coefficients of X and Y, ``(B, e, variables)``.
        scale: l.
        plus, minus: bounds of ``|P|`` and ``|M|``, rounding included.
        radius_x, radius_y: of ``|X|`` and ``|Y|``.
        middle: what the product's form counts of ``X Y`` itself; the rest is its error.
        magnitude_x, magnitude_y: of the factors.
    """

    x: Array
    y: Array
    scale: Array
    plus: Array
    minus: Array
    radius_x: Array
    radius_y: Array
    middle: Array
    magnitude_x: Array
    magnitude_y: Array

    @property
    def sum(self) -> Array:
        """Coefficients of P."""
        return self.x * self.scale[..., None] + self.y / self.scale[..., None]

    @property
    def difference(self) -> Array:
        """Coefficients of M."""
        return self.x * self.scale[..., None] - self.y / self.scale[..., None]

    @property
    def size(self) -> Array:
        """Bound of ``|l X|`` and ``|Y / l|``, rounding included."""
        return np.maximum(self.radius_x * self.scale, self.radius_y / self.scale) * SAFETY

    @property
    def magnitude(self) -> Array:
        """Of ``l X`` and ``Y / l`` together."""
        return self.magnitude_x * self.scale + self.magnitude_y / self.scale


class Relaxed(NamedTuple):
    """One nonlinear operation of a step, as it was relaxed: all that a certificate or a backward pass needs of it.

    Attributes:
        name: of the operation.
        band: the one used; of a product its scale, middle and radius.
        radius: of the variables it added, rounding included: the band's error is ``radius * z``, ``(B, e)``.
        first: index of the first of them.
        form: the input's; of a product the product's own.
        lower, upper: the input's bounds that the band was made for (None for a product).
        node: what was evaluated.
        factors: of a product.
        given: what else the lines depend on, after the bounds, in the input's shape.
        turn: of an angle, the direction across which its input is (:mod:`.relaxations.arctangent2`).
        ratio: of a choice, what of the difference of both goes with the condition, ``(B, e)``.
    """

    name: str
    band: Band
    radius: Array
    first: int
    form: Value
    lower: Array | None = None
    upper: Array | None = None
    node: Node | None = None
    factors: Factors | None = None
    given: tuple[Array, ...] = ()
    turn: Turn | None = None
    ratio: Array | None = None


class Frame:
    """The state set before a step, and the variables of the step so far.

    Args:
        states: the set, one for each of B cells.
        inputs: how many states and disturbances there are.
        own_radius: radii of all variables that a step has but the states, ``(v,)`` or for each cell ``(B, 1, v)``.
        hints: what is known of the operations.

    Attributes:
        both: centre and magnitude of the states, ``(2, B, n)``.
        size: number of variables so far.
        relaxed: the operations so far.
        beside: what intervals know of the operation whose turn it is; None if nothing is known.
        operand: bounds of the operand, or the first operands, of the operation whose turn it is, by form.
    """

    def __init__(
        self,
        states: Zonotope,
        *,
        inputs: int,
        own_radius: Array,
        hints: Hints | None = None,
        beside: Beside | None = None,
    ) -> None:
        self._m = functions_of(states.center)
        self.both = self._m.stack([states.center, abs(states.center) + states.reach + TINY])
        self.states, self.hints, self.own_radius = states, hints, own_radius
        self.size = inputs
        self.relaxed: list[Relaxed] = []
        self.beside = beside
        self.operand: tuple[Array, Array] | None = None

    @property
    def sum_error(self) -> float:
        """Relative error of sums over all symbols and of the products with the generators."""
        return over_symbols(self.states.order, self.size)

    def rounding(self, after: Value) -> Array:
        """What the next state is off by, that of its coefficients in terms of all symbols included."""
        return after.both[1] * ((after.error + of_generators(self.both.shape[-1])) * SAFETY)

    def advanced(self, after: Value) -> Zonotope:
        """The set after the step whose next state that is; every variable of the step has a generator."""
        n = self.both.shape[-1]
        own = widened(after.coefficients[..., n:], self.size - n)
        return self.states.affine_map(
            after.coefficients[..., :n],
            after.both[0],
            fresh=own,
            radius=self.own_radius[..., : own.shape[-1]],
            rounding=self.rounding(after),
        )

    def rows(self, coefficients: Array) -> Array:
        """A vector in terms of all symbols, ``(B, e, symbols)``; of tensors."""
        n = self.both.shape[-1]
        of_state, own = coefficients[..., :n] @ self.states.generators, coefficients[..., n:]
        scaled = own * self.own_radius[..., : own.shape[-1]]
        return self._m.cat([of_state, scaled.expand(len(of_state), -1, -1)], -1)

    def radius(self, coefficients: Array) -> Array:
        """Sums of the magnitudes of a vector's coefficients over all symbols, ``(B, e)``, but for rounding."""
        n, generators = self.both.shape[-1], self.states.generators
        of_state, own = coefficients[..., :n], coefficients[..., n:]
        sizes = self.own_radius[..., : own.shape[-1]]
        radius = abs(own) @ sizes if sizes.ndim == 1 else (abs(own) * sizes).sum(-1)
        if not isinstance(of_state, np.ndarray):
            return abs(of_state @ generators).sum(-1) + radius
        block = max(_BLOCK // (len(generators) * coefficients.shape[-2]), 64)
        if generators.shape[-1] <= block:
            part = of_state @ generators
            return radius + np.abs(part, out=part) @ _ONES[: part.shape[-1]]
        for first in range(0, generators.shape[-1], block):
            part = of_state @ generators[..., first : first + block]
            radius = radius + np.abs(part, out=part) @ _ONES[: part.shape[-1]]
        return radius

    def ratio(self, x: Value, y: Value) -> Array:
        """What of x goes with y, near the least squares of ``x - ratio y`` over all symbols; 0 if nothing does."""
        n, generators = self.both.shape[-1], self.states.generators
        gram = generators @ generators.swapaxes(-1, -2)
        sizes = self.own_radius[..., : max(x.coefficients.shape[-1], y.coefficients.shape[-1]) - n]
        weighted = [(v.coefficients[..., :n], v.coefficients[..., n:]) for v in (x, y)]

        def product(a: tuple[Array, Array], b: tuple[Array, Array]) -> Array:
            return ((a[0] @ gram) * b[0]).sum(-1) + (a[1] * b[1] * (sizes * sizes)).sum(-1)

        found = product(*weighted) / product(weighted[1], weighted[1])
        return self._m.nan_to_num(found, nan=0.0, posinf=0.0, neginf=0.0)

    def slack(self, x: Value) -> Array:
        """What of a radius and a centre is rounding."""
        return x.both[1] * ((x.error + self.sum_error) * SAFETY)

    def reach(self, x: Value) -> Array:
        """Upper bounds of ``|x - centre|``, rounding included."""
        return self.radius(x.coefficients) + self.slack(x)

    def bounds(self, x: Value) -> tuple[Array, Array]:
        """Lower and upper bounds, rounding included."""
        radius = self.reach(x)
        return x.both[0] - radius, x.both[0] + radius

    def bounds_at_kinks(self, x: Value) -> tuple[Array, Array]:
        """The same, but of entries that a rougher bound already shows to keep one sign in all cells that rougher one.

        Sums over all symbols are most of the time of a wide layer, and most of its neurons' signs are known without.
        """
        few = len(x.both[0][0]) < WIDE or self.states.order < 4 * self.states.dim
        if few or not isinstance(x.coefficients, np.ndarray):
            return self.bounds(x)
        n = self.states.dim
        own = abs(x.coefficients[..., n:])
        sizes = self.own_radius[..., : own.shape[-1]]
        of_own = own @ sizes if sizes.ndim == 1 else (own * sizes).sum(-1)
        rough = (abs(x.coefficients[..., :n]) @ self.states.reach[..., None])[..., 0] + of_own + self.slack(x)
        lower, upper = x.both[0] - rough, x.both[0] + rough
        open_ones = ~((lower >= 0) | (upper <= 0)).all(0)
        if open_ones.any():
            some = Value(x.both[..., open_ones], x.coefficients[:, open_ones], x.error)
            lower[:, open_ones], upper[:, open_ones] = self.bounds(some)
        return lower, upper

    def operand_bounds(self, x: Value) -> tuple[Array, Array]:
        """Bounds of the operand, or the first operands, of the operation whose turn it is: by form and by interval."""
        return self.sharpened(*self.bounds(x))

    def sharpened(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """The same, of which the form says this."""
        self.operand = lower, upper
        return self.operand if self.beside is None else self.beside.sharpened(lower, upper)

    def hint(self, name: str, size: int, after: Sequence[tuple[str, int]] = ()) -> Hint | None:
        """What is known of the next operation, or of the one that comes after these."""
        if self.hints is None:
            return None
        return hint_of(self.hints, name, size, [*((r.name, r.radius.shape[-1]) for r in self.relaxed), *after])

    def result(self, relaxed: Relaxed, center: Array, magnitude: Array, coefficients: Array, factor: Array) -> Value:
        """Note an operation: ``center + factor coefficients``, and a new variable of its radius per entry."""
        self.relaxed.append(relaxed)
        coefficients = with_fresh(coefficients, factor, self.size, relaxed.radius)
        self.size += relaxed.radius.shape[-1]
        return Value(self._m.stack([center, magnitude + relaxed.radius]), coefficients, BAND, relaxed.radius)


class Bounded(NamedTuple):
    """The operand of a function: its form, its bounds, the function's band over them, and of an angle more."""

    form: Value
    lower: Array
    upper: Array
    band: Band
    given: tuple[Array, ...] = ()
    turn: Turn | None = None
    ratio: Array | None = None


def _narrowed(lower: Array, upper: Array, hint: Hint | None) -> tuple[Array, Array]:
    """Bounds of an operation's input, intersected with what is known of it."""
    if hint is None or hint.lower is None or hint.upper is None:
        return lower, upper
    m = functions_of(lower)
    return m.maximum(lower, like(hint.lower, lower)), m.minimum(upper, like(hint.upper, lower))


def _function(node: Node, frame: Frame, x: Value) -> Value:
    """A function of one variable: its band over the operand's bounds."""
    assert node.relaxation is not None
    name, operation, parameters = node.relaxation
    bounds = frame.bounds_at_kinks(x) if name in ONE_KINK else frame.bounds(x)
    lower, upper = _narrowed(*frame.sharpened(*bounds), frame.hint(name, node.size))
    return enclosed(node, frame, Bounded(x, lower, upper, operation.band_of(lower, upper, *parameters)))


def sine_and_cosine_operands(node: Node, after: Node, frame: Frame, x: Value) -> tuple[Bounded, Bounded]:
    """Of a sine and the cosine that follows it, or the other way round."""
    assert node.relaxation is not None and after.relaxation is not None
    name = node.relaxation.name
    bounds, other = frame.operand_bounds(x), after.relaxation.name
    hints = frame.hint(name, node.size), frame.hint(other, node.size, [(name, node.size)])
    both = [_narrowed(*bounds, hint) for hint in hints]
    if not isinstance(bounds[0], np.ndarray):
        of = node.relaxation.operation, after.relaxation.operation
        first, second = (Bounded(x, *sides, how.band_of(*sides)) for how, sides in zip(of, both, strict=True))
        return first, second
    order = 1 if name == "sin" else -1
    lower, upper = (np.array(side) for side in zip(*both[::order], strict=True))
    bands = sine_and_cosine_bands(lower, upper)[::order]
    first, second = (Bounded(x, *sides, band) for sides, band in zip(both, bands, strict=True))
    return first, second


def enclosed(node: Node, frame: Frame, operand: Bounded) -> Value:
    """A function's result, within its band."""
    assert node.relaxation is not None
    x, lower, upper, band, given, turn, ratio = operand
    slope, offset, radius = band
    magnitude = abs(slope) * x.both[1] + abs(offset) + (radius + TINY)
    radius = radius * SAFETY + magnitude * ((x.error + BAND) * SAFETY)
    relaxed = Relaxed(
        node.relaxation.name, band, radius, frame.size, x, lower, upper, node, given=given, turn=turn, ratio=ratio
    )
    return frame.result(relaxed, x.both[0] * slope + offset, magnitude, x.coefficients, slope[..., None])


def _ends(
    frame: Frame, operands: Value, size: int, *, within: bool = False
) -> tuple[Array, Array, Array, Array, Array]:
    """Of two vectors X and Y one after the other: radii of both, ``l = sqrt(r_Y / r_X)``, and bounds of
    ``|l X + Y / l|`` and ``|l X - Y / l|``. The scale is a constant for autograd.

    Args:
        frame, operands, size: what, and entries of one of them.
        within: whether these are the operands of the operation whose turn it is.
    """
    m, arrays = functions_of(operands.both), isinstance(operands.both, np.ndarray)
    # Rounding of the sums, and of scaling (3 more units) is within twice the usual slack.
    slack = frame.slack(operands) * 2.0
    # Tensors are better summed from one product with the generators, arrays in blocks.
    parts = operands.coefficients if arrays else frame.rows(operands.coefficients)
    radius = (frame.radius(parts) if arrays else abs(parts).sum(-1)) + slack
    by_intervals = within and frame.beside is not None
    if within:
        center = operands.both[0]
        low, high = frame.sharpened(center - radius, center + radius)
        if by_intervals:  # X is off by the form's own rounding, which is in the slack
            radius = m.fmin(radius, m.maximum(high - center, center - low) * SAFETY + slack)
    radius_x, radius_y = radius[:, :size], radius[:, size:]
    with constant(radius):
        ratio = m.sqrt(radius_y / radius_x)
    x, y = parts[:, :size] * ratio[..., None], parts[:, size:] / ratio[..., None]
    doubt = (slack[:, :size] * ratio + slack[:, size:] / ratio) * SAFETY
    both = m.cat([x + y, x - y], -2)
    ends = frame.radius(both) if arrays else abs(both).sum(-1)
    plus, minus = ends[:, :size] + doubt, ends[:, size:] + doubt
    if by_intervals:
        most = (radius_x * ratio + radius_y / ratio) * SAFETY
        plus, minus = m.fmin(plus, most), m.fmin(minus, most)
    return radius_x, radius_y, ratio, plus, minus


def _product(node: Node, frame: Frame, operands: Value, *, within: bool = True) -> Value:
    """The product of the first half of the entries and the second, whose deviations may be correlated.

    ``(c + X)(d + Y) = c d + c Y + d X + X Y`` and, with ``P = l X + Y / l`` and ``M = l X - Y / l`` for any l > 0,
    ``X Y = (P^2 - M^2) / 4`` lies in ``[-r_M^2 / 4, r_P^2 / 4]``: equal to the usual ``r_X r_Y`` for independent
    operands, up to half as wide for correlated ones (exact for a square). Best is ``l = sqrt(r_Y / r_X)``.
    """
    m, size, error = functions_of(operands.both), node.size, operands.error
    gx, gy = operands.coefficients[:, :size], operands.coefficients[:, size:]
    radius_x, radius_y, ratio, plus, minus = _ends(frame, operands, size, within=within)
    high, low = plus * plus * 0.25, minus * minus * 0.25
    middle, half = 0.5 * (high - low), 0.5 * (high + low)
    (c, mx), (d, my) = operands.both[..., :size], operands.both[..., size:]
    magnitude = abs(c) * my + abs(d) * mx + half + TINY  # |c| my >= |c d|, and half >= |middle|
    center, coefficients = c * d + middle, c[..., None] * gy + d[..., None] * gx
    relaxed = Relaxed(
        "product",
        Band(ratio, middle, half * (1.0 + ROUNDED)),
        half * SAFETY + magnitude * (of_product(error) * SAFETY),
        frame.size,
        Value(m.stack([center, magnitude]), coefficients, error),
        factors=Factors(gx, gy, ratio, plus, minus, radius_x, radius_y, middle, mx, my),
    )
    return frame.result(relaxed, center, magnitude, coefficients, 1.0)


def _quotient(node: Node, frame: Frame, operands: Value) -> Value:
    """``a / b = q + (a - q b) (1 / b)`` for any q: near the centres' quotient what the two share cancels before."""
    m, size = functions_of(operands.both), node.size
    (a, size_a), (b, size_b), reciprocal = (operands.both[..., i * size : (i + 1) * size] for i in range(3))
    of_a, of_b, rest = (operands.coefficients[:, i * size : (i + 1) * size] for i in range(3))
    with constant(a):
        q = m.nan_to_num(a / b, nan=0.0, posinf=0.0, neginf=0.0)
    difference = m.stack([a - q * b, size_a + abs(q) * size_b + TINY])
    factors = Value(
        m.cat([difference, reciprocal], -1),
        m.cat([of_a - q[..., None] * of_b, rest], -2),
        operands.error + SHIFT,
    )
    product = _product(node, frame, factors, within=False)
    return Value(product.both + m.stack([q, abs(q)]), product.coefficients, product.error + SHIFT)


def _extreme(node: Node, frame: Frame, operands: Value) -> Value:
    """``maximum(a, b)`` is ``b + relu(a - b)``, ``minimum(a, b)`` is ``a - relu(a - b)`` and ``logaddexp(a, b)`` is
    ``b + softplus(a - b)``.
    """
    m, size, largest = functions_of(operands.both), node.size, node.rule != "minimum"
    difference = Value(operands.both[..., :size], operands.coefficients[:, :size], operands.error)
    above = _function(node, frame, difference)
    other = slice(2 * size, None) if largest else slice(size, 2 * size)
    sign = 1.0 if largest else -1.0
    center, magnitude = operands.both[..., other]
    both = m.stack([center + sign * above.both[0], magnitude + above.both[1]])
    coefficients = added(sign * above.coefficients, operands.coefficients[:, other])
    return Value(both, coefficients, max(operands.error, above.error) + SUM)


def _choice(node: Node, frame: Frame, operands: Value) -> Value:
    """``b`` and, where c is positive, ``a - b``; where it is known which, that one itself."""
    assert node.relaxation is not None
    m, n = functions_of(operands.both), node.size
    difference, condition, a, b = (
        Value(operands.both[..., part], operands.coefficients[:, part], operands.error)
        for part in (slice(i * n, (i + 1) * n) for i in range(4))
    )
    first = Value(operands.both[..., : 2 * n], operands.coefficients[:, : 2 * n], operands.error)
    lower, upper = frame.operand_bounds(first)
    with constant(lower):
        ratio = frame.ratio(difference, condition)
    (d, size_d), (c, size_c) = difference.both, condition.both
    rest = Value(
        m.stack([d - ratio * c, size_d + abs(ratio) * size_c + TINY]),
        difference.coefficients - ratio[..., None] * condition.coefficients,
        operands.error + SHIFT,
    )
    ends = (lower[:, :n], upper[:, :n], lower[:, n:], upper[:, n:], ratio, *frame.bounds(rest))
    chosen, *_ = given = on_tensors(_choices.sides, *map(contiguous, ends))
    lower, upper = _narrowed(lower[:, :n], upper[:, :n], frame.hint("where", n))
    band = node.relaxation.operation.band_of(lower, upper, *given)
    open_ = chosen == 0
    moving = Value(
        m.where(open_, difference.both, 0.0), m.where(open_[..., None], difference.coefficients, 0.0), operands.error
    )
    moved = enclosed(node, frame, Bounded(moving, lower, upper, band, given, ratio=ratio))
    start = m.where(open_[..., None], b.coefficients, m.where(chosen[..., None] > 0, a.coefficients, b.coefficients))
    both = m.where(chosen > 0, a.both, b.both)
    own = m.where(open_[..., None], moved.coefficients, 0.0)
    return Value(both + m.where(open_, moved.both, 0.0), added(own, start), max(operands.error, moved.error) + SUM)


def _angle(node: Node, frame: Frame, operands: Value) -> Value:
    """The angle of a point, of its distance across a direction in the middle of its angles."""
    assert node.relaxation is not None
    m, size, hint = functions_of(operands.both), node.size, frame.hint("atan2", node.size)
    lower, upper = frame.operand_bounds(operands)
    sides = (lower[:, :size], upper[:, :size], lower[:, size:], upper[:, size:])
    low, high = on_tensors(_arctangent2.value_range, *map(contiguous, sides))
    if hint is None or hint.turn is None:
        turn = on_tensors(_arctangent2.turn, low, high)
    else:
        turn = Turn(*(like(part, low) for part in hint.turn))
    c, s, angle = turn
    (y, size_y), (x, size_x) = operands.both[..., :size], operands.both[..., size:]
    gy, gx = operands.coefficients[:, :size], operands.coefficients[:, size:]
    magnitude = [abs(c) * size_y + abs(s) * size_x + TINY, abs(c) * size_x + abs(s) * size_y + TINY]
    turned = Value(
        m.cat([m.stack([c * y - s * x, magnitude[0]]), m.stack([c * x + s * y, magnitude[1]])], -1),
        m.cat([c[..., None] * gy - s[..., None] * gx, c[..., None] * gx + s[..., None] * gy], -2),
        operands.error + SHIFT,
    )
    lower, upper = frame.bounds(turned)
    _, radius, _, plus, minus = _ends(frame, turned, size)
    center, middle = turned.both[0][:, :size], turned.both[0][:, size:]
    twist = _arctangent2.twist(center, radius, plus, minus)
    given = (lower[:, size:], upper[:, size:], middle, *twist, angle, low, high)
    across = Value(turned.both[..., :size], turned.coefficients[:, :size], turned.error)
    lower, upper = _narrowed(lower[:, :size], upper[:, :size], hint)
    band = node.relaxation.operation.band_of(lower, upper, *given)
    return enclosed(node, frame, Bounded(across, lower, upper, band, given, turn))


def _sums(node: Node, frame: Frame, operands: Value) -> Value:
    """Sums of products as float32 arithmetic gives them: the exact ones, and an error that the terms' sizes bound."""
    assert node.relaxation is not None
    m, size = functions_of(operands.both), node.size
    lower, upper = frame.operand_bounds(operands)
    matrix, bias = (p if m is functions_of(p) else p.numpy() for p in node.relaxation.parameters)
    with constant(lower):
        terms = sizes_of_sums(lower[:, size:], upper[:, size:], matrix, bias)
        error = error_of_sums(terms, matrix.shape[-1])
    form = Value(operands.both[..., :size], operands.coefficients[:, :size], operands.error)
    lower, upper = lower[:, :size], upper[:, :size]
    band = node.relaxation.operation.band_of(lower, upper, error)
    return enclosed(node, frame, Bounded(form, lower, upper, band, given=(error,)))


WIDE = 48
"""Entries of an operation from which on signs are looked for first."""
_BLOCK = 2**16
"""Entries of an array that stays in the processor's cache."""
_ONES = np.ones(_BLOCK)
EVALUATE: dict[str, Callable[[Node, Frame, Value], Value]] = {
    "function": _function,
    "product": _product,
    "quotient": _quotient,
    "angle": _angle,
    "maximum": _extreme,
    "minimum": _extreme,
    "logaddexp": _extreme,
    "choice": _choice,
    "sums": _sums,
}
