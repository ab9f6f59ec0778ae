"""Forward affine arithmetic on arrays: what :class:`~sagemp_cli.reachability.affine.Affine` does to a foldable loop.

The enclosures are those of :mod:`sagemp_cli.reachability.affine_form`, with the same variables in the same order, the
same account of rounding and the same records. But all that is linear between two nonlinear operations is one matrix
product (:mod:`sagemp_cli.reachability.folding`), and arrays take the place of tensors: on the few numbers of a step an
operation of numpy costs a fifth of one of torch. Not differentiable.

Of float64 arrays is used that sums and products are correctly rounded, in whatever order a sum of products is taken,
with or without fused multiply-add.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.reachability.affine_form import SAFETY, AffineForm, Factors, Hints, Relaxed, StepFrame
from sagemp_cli.reachability.folding import Combination, FoldableLoop, Node, NotFoldable, Plan, plan_of
from sagemp_cli.reachability.reduction import reduce_generators
from sagemp_cli.reachability.relaxations.band import TINY, UNIT, Band
from sagemp_cli.reachability.relaxations.functions import on_tensors
from sagemp_cli.reachability.relaxations.sine import sine_and_cosine_bands
from sagemp_cli.sets import Box, Tube

Array = np.ndarray


@dataclass
class PlannedRun:
    """What a forward pass found: see :class:`~sagemp_cli.reachability.affine.AffineRun`.

    Attributes:
        controls: per step, bounds of the control; empty unless asked for.
    """

    tube: Tube
    bands: list[list[tuple[str, Band]]]
    kept: list[Tensor]
    steps: list[AffineForm]
    controls: list[tuple[Tensor, Tensor]]


@torch.no_grad()
@np.errstate(all="ignore")  # what overflows has infinite bounds
def planned_run(
    loop: FoldableLoop,
    start: Box,
    disturbance: Box,
    steps: int,
    *,
    symbols: int | None,
    hints: Sequence[Hints] | None,
    keep_steps: bool,
    watch: bool,
) -> PlannedRun:
    """Propagate a start box ``(*batch, n)``.

    Args:
        loop, start, disturbance: see :class:`~sagemp_cli.reachability.propagator.Propagator`.
        steps: how many.
        symbols: most generators kept between steps (None: all that are not negligible).
        hints: per step, bounds of the operations' inputs that are known to hold.
        keep_steps: keep every step's form, for a backward pass.
        watch: bound the controls.

    Raises:
        NotFoldable: the loop has no plan, or references of a larger batch than the start box.
    """
    batch, n = start.lower.shape[:-1], start.dim
    plan = _Prepared(loop, steps, batch, n, disturbance)
    back = _Back(batch)
    low, high = (side.reshape(-1, n).numpy() for side in (start.lower, start.upper))
    center, reach = (side.reshape(-1, n).numpy() for side in (start.center, start.radius))
    generators = reach[:, :, None] * np.eye(n)
    lowers, uppers, found = [low], [high], PlannedRun(Tube(start.lower, start.upper), [], [], [], [])
    records, again = [], 0
    for k in range(steps):
        states = _States(center, reach, generators, plan, None if hints is None else hints[k])
        after, control = plan.step(k, states)
        records.append(states.records)
        if watch and control is not None:
            found.controls.append(tuple(map(back.vector, states.bounds(control))))
        if keep_steps:
            found.steps.append(back.form(states, after, disturbance))
        center, generators = after.both[0], states.rows(after.coefficients, extra=n)
        _diagonal(generators, generators.shape[-1] - n)[...] = after.both[1] * (
            (after.error + (2 * n + 16) * UNIT) * SAFETY
        )
        count = generators.shape[-1]
        if count > again or (symbols is not None and count > max(symbols, n + 1)):
            reduced, mask = reduce_generators(torch.from_numpy(generators), symbols)
            generators = reduced.numpy()
            again = max(generators.shape[-1] * 5 // 4, generators.shape[-1] + 64)
            found.kept.append(mask if mask.dim() == 1 else mask.reshape(*batch, -1))
        else:
            found.kept.append(torch.ones(count, dtype=torch.bool))
        reach = np.add.reduce(np.abs(generators), axis=-1) * (1.0 + 2 * (generators.shape[-1] + 8) * UNIT)
        spread = reach * (1.0 + 2 * UNIT) + np.abs(center) * (2 * UNIT)
        lowers.append(center - spread)
        uppers.append(center + spread)
        if not math.isfinite(reach.sum()):
            bad = ~np.isfinite(reach).all(-1)
            lowers[-1][bad], uppers[-1][bad] = -math.inf, math.inf
            center[bad], generators[bad], reach[bad] = math.nan, math.nan, math.nan
    found.bands += [[(r.name, Band(*map(back.vector, r.band))) for r in step] for step in records]
    found.tube = Tube(*(back.vector(np.stack(side, axis=1)) for side in (lowers, uppers)))
    return found


class _Value(NamedTuple):
    """A vector in the form of :mod:`~sagemp_cli.reachability.affine_form`, cells first.

    Attributes:
        both: centre and magnitude, ``(2, B, e)``.
        coefficients: ``(B, e, variables)``, or for all cells ``(1, e, variables)``.
        error: relative rounding error.
    """

    both: Array
    coefficients: Array
    error: float


class _Record(NamedTuple):
    """A nonlinear operation as :class:`~sagemp_cli.reachability.affine_form.Relaxed` describes it."""

    name: str
    band: Band
    radius: Array
    first: int
    form: _Value
    lower: Array | None = None
    upper: Array | None = None
    node: Node | None = None
    factors: tuple[Array, ...] = ()


class _States:
    """The state set before a step, and the variables of the step so far: the array's counterpart of
    :class:`~sagemp_cli.reachability.affine_form.StepFrame`.
    """

    def __init__(self, center: Array, reach: Array, generators: Array, plan: _Prepared, hints: Hints | None) -> None:
        self.both = np.array([center, np.abs(center) + reach + TINY])
        self.reach, self.generators, self.hints = reach, generators, hints
        self.own_radius = plan.own_radius
        self.size = plan.inputs
        self.records: list[_Record] = []

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

    def bounds(self, x: _Value) -> tuple[Array, Array]:
        """Lower and upper bounds, rounding included."""
        rows = self.rows(x.coefficients)
        radius = np.add.reduce(np.abs(rows, out=rows), axis=-1)
        radius += x.both[1] * ((x.error + self.sum_error) * SAFETY)
        return x.both[0] - radius, x.both[0] + radius

    def narrowed(self, lower: Array, upper: Array, operation: int) -> tuple[Array, Array]:
        """The bounds of an operation's input, intersected with what is known of it."""
        hint = None if self.hints is None else self.hints[operation]
        if hint is None:
            return lower, upper
        known = (side.reshape(lower.shape).numpy() for side in hint)
        return np.maximum(lower, next(known)), np.minimum(upper, next(known))

    def result(self, record: _Record, center: Array, magnitude: Array, coefficients: Array, factor: Array) -> _Value:
        """Note an operation: ``center + factor coefficients``, and a new variable of the record's radius per entry."""
        self.records.append(record)
        radius, size = record.radius, record.radius.shape[-1]
        out = np.zeros((len(self.generators), size, self.size + size))
        np.multiply(coefficients, factor, out=out[..., : coefficients.shape[-1]])
        _diagonal(out, self.size)[...] = radius
        self.size += size
        return _Value(np.array([center, magnitude + radius]), out, 4 * UNIT)


def _diagonal(rows: Array, first: int) -> Array:
    """The entries ``(i, first + i)`` of contiguous matrices ``(B, e, first + e)``, to be written."""
    cells, size, width = rows.shape
    return rows.reshape(cells, size * width)[:, first :: width + 1]


class _Prepared:
    """A plan with its numbers."""

    def __init__(self, loop: FoldableLoop, steps: int, batch: torch.Size, n: int, disturbance: Box) -> None:
        given = torch.stack([loop.given(k) for k in range(steps)])
        own = given.shape[1 : given.dim() - loop.given_dim]
        shape = given.shape[1 + len(own) :]
        if len(own) > len(batch) or torch.broadcast_shapes(own, batch) != batch:
            raise NotFoldable
        plan = plan_of(loop, shape, n, disturbance.dim)
        if len(own):
            given = given.reshape(steps, *[1] * (len(batch) - len(own)), *given.shape[1:]).expand(steps, *batch, *shape)
        given = given.reshape(steps, math.prod(batch) if len(own) else 1, math.prod(shape))
        self.inputs = n + disturbance.dim
        entries = sum(node.size for node in plan.nodes)
        self.own_radius = np.concatenate([disturbance.radius.numpy(), np.ones(entries)])
        self._nodes = [(node, _Fold(plan, node.operands, given, disturbance)) for node in plan.nodes]
        self._pairs = _pairs(plan.nodes)
        self._state = _Fold(plan, plan.state, given, disturbance)
        self._control = None if plan.control is None else _Fold(plan, plan.control, given, disturbance)

    def step(self, k: int, states: _States) -> tuple[_Value, _Value | None]:
        """The next state, and the control if the loop has one."""
        results: list[_Value] = []
        known: list[_Bounded] = []  # of a function whose turn is next
        for i, (node, fold) in enumerate(self._nodes):
            if known:
                results.append(_enclosed(node, states, known.pop()))
            elif i in self._pairs:
                first, second = _sine_and_cosine(node, states, fold(k, states, results))
                results.append(_enclosed(node, states, first))
                known.append(second)
            else:
                results.append(_EVALUATE[node.kind](node, states, fold(k, states, results)))
        control = None if self._control is None else self._control(k, states, results)
        return self._state(k, states, results), control


def _pairs(nodes: Sequence[Node]) -> set[int]:
    """Sines and cosines that a cosine or sine of the same values follows."""

    def same(a: Combination, b: Combination) -> bool:
        width = a.matrix.shape[-1]
        if a.error != b.error or a.matrix.shape[0] != b.matrix.shape[0] or bool(b.sizes[:, width:].any()):
            return False
        return torch.equal(a.matrix, b.matrix[:, :width]) and torch.equal(a.sizes, b.sizes[:, :width])

    return {
        i
        for i, (a, b) in enumerate(itertools.pairwise(nodes))
        if {a.name, b.name} == {"sin", "cos"} and same(a.operands, b.operands)
    }


class _Fold:
    """A combination, ready for one propagation: what the given numbers and the disturbance's centre contribute to the
    constants is known for all steps.
    """

    def __init__(self, plan: Plan, combination: Combination, given: Tensor, disturbance: Box) -> None:
        linear = torch.nn.functional.linear
        matrix, sizes = (plan.split(side.detach()) for side in combination[:2])
        used = [bool(part.any()) for part in sizes]
        w = disturbance.center
        constant = matrix[0][:, 0] + linear(w, matrix[3])
        size = sizes[0][:, 0] + linear(w.abs() + disturbance.radius + TINY, sizes[3]) + TINY
        self._varies = used[1]
        if used[1]:
            constant, size = constant + linear(given, matrix[1]), size + linear(given.abs(), sizes[1])
            self._constant = torch.stack([constant, size], dim=1).numpy()
        else:
            self._constant = torch.stack([constant, size])[:, None].numpy()

        def sided(i: int) -> Array:
            return torch.stack([matrix[i].mT, sizes[i].mT]).contiguous().numpy()

        self._of_state = sided(2) if used[2] else None
        self._of_results = [
            (i - 4, matrix[i].contiguous().numpy(), sided(i)) for i in range(len(used) - 1, 3, -1) if used[i]
        ]
        # Coefficients of state and disturbance; results are taken the latest first, which has most variables.
        self._direct: Array | None = None
        if used[3]:
            self._direct = torch.cat([matrix[2], matrix[3]], dim=-1)[None].numpy()
        elif used[2] or not self._of_results:
            self._direct = matrix[2].contiguous()[None].numpy()
        length = sum(part.shape[-1] for part, some in zip(matrix, used, strict=True) if some)
        self._error = combination.error + (length + 8) * UNIT

    def __call__(self, k: int, states: _States, results: Sequence[_Value]) -> _Value:
        """The combination at step k."""
        both = self._constant[k] if self._varies else self._constant
        if self._of_state is not None:
            both = both + states.both @ self._of_state
        coefficients, error = None, 0.0
        for i, matrix, sided in self._of_results:
            result = results[i]
            both = both + result.both @ sided
            error = max(error, result.error)
            part = matrix @ result.coefficients
            if coefficients is None:
                coefficients = part
            else:
                coefficients[..., : part.shape[-1]] += part
        if coefficients is None:
            coefficients = self._direct
        elif self._direct is not None:
            coefficients[..., : self._direct.shape[-1]] += self._direct
        if both.shape[1] != states.both.shape[1]:
            both = np.repeat(both, states.both.shape[1], axis=1)
        return _Value(both, coefficients, self._error + error)


class _Bounded(NamedTuple):
    """The operand of a function: its form, its bounds, and the function's band over them."""

    form: _Value
    lower: Array
    upper: Array
    band: Band


def _scalar(node: Node, states: _States, x: _Value) -> _Value:
    """A function of one variable: its band over the operand's bounds."""
    lower, upper = states.narrowed(*states.bounds(x), len(states.records))
    operation = node.operation
    assert operation is not None
    if operation.arrays:
        band = operation.band(lower, upper, *node.parameters)
    else:
        band = on_tensors(lambda low, high: operation.band(low, high, *node.parameters), lower, upper)
    return _enclosed(node, states, _Bounded(x, lower, upper, band))


def _sine_and_cosine(node: Node, states: _States, x: _Value) -> tuple[_Bounded, _Bounded]:
    """Of a sine and the cosine that follows it, or the other way round."""
    bounds, turn = states.bounds(x), len(states.records)
    both = [states.narrowed(*bounds, turn), states.narrowed(*bounds, turn + 1)]
    order = 1 if node.name == "sin" else -1
    lower, upper = (np.array(side) for side in zip(*both[::order], strict=True))
    bands = sine_and_cosine_bands(lower, upper)[::order]
    first, second = (_Bounded(x, *sides, band) for sides, band in zip(both, bands, strict=True))
    return first, second


def _enclosed(node: Node, states: _States, operand: _Bounded) -> _Value:
    """A function's result, within its band."""
    x, lower, upper, band = operand
    slope, offset, radius = band
    magnitude = np.abs(slope) * x.both[1] + np.abs(offset) + (radius + TINY)
    radius = radius * SAFETY + magnitude * ((x.error + 4 * UNIT) * SAFETY)
    record = _Record(node.name, band, radius, states.size, x, lower, upper, node)
    return states.result(record, x.both[0] * slope + offset, magnitude, x.coefficients, slope[..., None])


def _product(node: Node, states: _States, operands: _Value) -> _Value:
    """The product of the first half of the entries and the second.

    ``(c + X)(d + Y) = c d + c Y + d X + X Y`` and ``X Y = (P^2 - M^2) / 4``: see ``_product`` of
    :mod:`~sagemp_cli.reachability.affine_operations`, which this is for arrays.
    """
    size, error = node.size, operands.error
    rows = states.rows(operands.coefficients)
    # Rounding of the rows, of their sums, and of scaling (2 more units each) is within twice the usual slack.
    slack = operands.both[1] * (2 * (error + states.sum_error) * SAFETY)
    radius = np.add.reduce(np.abs(rows), axis=-1) + slack
    radius_x, radius_y = radius[:, :size], radius[:, size:]
    ratio = np.sqrt(radius_y / radius_x)
    x, y = rows[:, :size], rows[:, size:]
    x *= ratio[..., None]
    y /= ratio[..., None]
    doubt = (slack[:, :size] * ratio + slack[:, size:] / ratio) * SAFETY
    both = x + y
    plus = np.add.reduce(np.abs(both, out=both), axis=-1) + doubt
    np.subtract(x, y, out=both)
    minus = np.add.reduce(np.abs(both, out=both), axis=-1) + doubt
    high, low = plus * plus * 0.25, minus * minus * 0.25
    middle, half = 0.5 * (high - low), 0.5 * (high + low)
    (c, mx), (d, my) = operands.both[..., :size], operands.both[..., size:]
    gx, gy = operands.coefficients[:, :size], operands.coefficients[:, size:]
    magnitude = np.abs(c) * my + np.abs(d) * mx + half + TINY  # |c| my >= |c d|, and half >= |middle|
    center, coefficients = c * d + middle, c[..., None] * gy + d[..., None] * gx
    record = _Record(
        "product",
        Band(ratio, middle, half),
        half * SAFETY + magnitude * ((2 * error + 16 * UNIT) * SAFETY),
        states.size,
        _Value(np.array([center, magnitude]), coefficients, error),
        factors=(gx, gy, ratio, plus, minus, radius_x, radius_y, middle, mx, my),
    )
    return states.result(record, center, magnitude, coefficients, _ONE)


def _quotient(node: Node, states: _States, operands: _Value) -> _Value:
    """``a / b = q + (a - q b) (1 / b)`` for any q: near the centres' quotient what the two share cancels before."""
    size = node.size
    (a, size_a), (b, size_b), reciprocal = (operands.both[..., i * size : (i + 1) * size] for i in range(3))
    of_a, of_b, rest = (operands.coefficients[:, i * size : (i + 1) * size] for i in range(3))
    q = np.nan_to_num(a / b, nan=0.0, posinf=0.0, neginf=0.0)
    difference = np.array([a - q * b, size_a + np.abs(q) * size_b + TINY])
    factors = _Value(
        np.concatenate([difference, reciprocal], axis=-1),
        np.concatenate([of_a - q[..., None] * of_b, rest], axis=-2),
        operands.error + 2 * UNIT,
    )
    product = _product(node, states, factors)
    return _Value(product.both + np.array([q, np.abs(q)]), product.coefficients, product.error + 2 * UNIT)


_ONE = np.ones(1)
_EVALUATE: dict[str, Callable[[Node, _States, _Value], _Value]] = {
    "scalar": _scalar,
    "product": _product,
    "quotient": _quotient,
}


class _Back(NamedTuple):
    """From arrays with the cells first to tensors in the batch shape."""

    batch: torch.Size

    def vector(self, array: Array) -> Tensor:
        """``(B, ...)`` as ``(*batch, ...)``."""
        return torch.from_numpy(array).reshape(*self.batch, *array.shape[1:])

    def coefficients(self, array: Array) -> Tensor:
        """``(variables, *batch, e)``."""
        count = math.prod(self.batch)
        return torch.from_numpy(array).expand(count, -1, -1).reshape(*self.batch, *array.shape[1:]).movedim(-1, 0)

    def form(self, states: _States, value: _Value, disturbance: Box) -> AffineForm:
        """The next state, and in its frame what went into it."""
        frame = StepFrame(self.vector(states.generators), self.vector(states.reach), disturbance.radius)
        frame.size = states.size
        frame.relaxations = [self._relaxed(r) for r in states.records]
        frame.condense()
        center, magnitude = map(self.vector, value.both)
        coefficients = self.coefficients(value.coefficients)
        missing = coefficients.new_zeros(states.size - len(coefficients), *coefficients.shape[1:])
        return AffineForm(frame, center, torch.cat([coefficients, missing]), magnitude, value.error)

    def _relaxed(self, r: _Record) -> Relaxed:
        center, magnitude = map(self.vector, r.form.both)
        own = (None, None, None, ())
        if r.node is not None and r.lower is not None and r.upper is not None:
            own = (self.vector(r.lower), self.vector(r.upper), r.node.operation, r.node.parameters)
        factors = None
        if r.factors:
            factors = Factors(*map(self.coefficients, r.factors[:2]), *map(self.vector, r.factors[2:]))
        band, radius = Band(*map(self.vector, r.band)), self.vector(r.radius)
        coefficients = self.coefficients(r.form.coefficients)
        return Relaxed(r.name, band, radius, r.first, center, coefficients, magnitude, r.form.error, *own, factors)
