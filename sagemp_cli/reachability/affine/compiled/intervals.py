"""The intervals of a step's values, carried beside their forms.

A form is a centre and what deviates from it, so its bounds reach past what a function can give: ``clamp`` to +-1 over
+-3 has a form that gives +-2, a sum of squares one that reaches below 0. An interval knows the function's range and
forgets how values hang together. Both hold, so each sharpens the other: an operation is relaxed over what its operand's
form *and* interval allow, and the range of the function over that is the interval of its result.

Between two operations an interval is a combination of those before, as a form is (:mod:`.affine.compiled.folding`),
which is sharper than one instruction after the other. Ends are kept as ``[upper, -lower]``: both are upper bounds, and
a combination is a matrix that is not negative.

Rounding: see :class:`_Fold`; the functions' ranges include theirs.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import Tensor

from sagemp_cli.reachability.affine.compiled.folding import Combination, Compiled, Node
from sagemp_cli.reachability.interval.form import IntervalForm, evaluate
from sagemp_cli.reachability.program.program import Instruction
from sagemp_cli.reachability.relaxations.float32 import error_of_sums, sizes_of_sums, widened
from sagemp_cli.reachability.relaxations.functions import all_finite
from sagemp_cli.sets import Box
from sagemp_cli.sets.rounding import SAFETY, TINY, combined

Array = np.ndarray
Sides = tuple[Array, Array]
"""Lower and upper bounds ``(B, entries)``; infinite where nothing is known."""

_KINDS = {
    "product": "mul", "quotient": "div", "angle": "atan2", "maximum": "maximum", "minimum": "minimum",
    "logaddexp": "logaddexp", "choice": "where",
}  # fmt: skip


class Intervals:
    """A compiled step, ready for intervals.

    Args:
        step: it.
        numbers: of all steps, ``(K, B, g)`` or ``(K, 1, g)``.
        disturbance: W.
    """

    def __init__(self, step: Compiled, numbers: Tensor, disturbance: Box) -> None:
        self.first = step.columns
        self.nodes, self.numbers = step.nodes, numbers.detach().numpy()
        self.disturbance = tuple(side.detach().numpy() for side in (disturbance.lower, disturbance.upper))
        self.operands, self.squares, self.next, self.watched = _ready(step)


@functools.lru_cache(maxsize=8)
def _ready(step: Compiled) -> tuple[list[_Fold], list[Array | None], _Fold, _Fold | None]:
    """Of all operations the operands, and which are squares; the next state, and what is watched."""
    watched = None if step.watched is None else _Fold(step.watched)
    operands, squares = [_Fold(node.operands) for node in step.nodes], [_squares(node) for node in step.nodes]
    return operands, squares, _Fold(step.outputs.next), watched


class Carried:
    """The intervals of one step, or of several, one after the other.

    Args:
        intervals: of their program.
        steps: which they are.
        low, high: of the states, ``(steps * B, n)``.
    """

    def __init__(self, intervals: Intervals, steps: Sequence[int], low: Array, high: Array) -> None:
        self._of = intervals
        self._ends = np.zeros((2, len(low), 2, intervals.first[-1]))  # the ends, and their sizes
        cells = len(low) // len(steps)
        numbers = intervals.numbers[list(steps)]
        numbers = np.broadcast_to(numbers, (len(steps), cells, numbers.shape[-1])).reshape(len(low), -1)
        self._put(1, numbers, numbers)
        self._put(2, low, high)
        disturbance = intervals.disturbance
        if disturbance[0].ndim > 1:
            disturbance = tuple(side[list(steps)].reshape(len(low), -1) for side in disturbance)
        self._put(3, *disturbance)

    def operand(self, i: int) -> Sides:
        """Bounds of the operands of operation i, of which all before are known."""
        return self._of.operands[i](self._ends)

    def next(self) -> Sides:
        """Of the next state."""
        return self._of.next(self._ends)

    def watched(self) -> Sides:
        """Of controls and deviations, of a step that says them."""
        assert self._of.watched is not None
        return self._of.watched(self._ends)

    def know(self, i: int, operands: Sides) -> None:
        """The result of operation i, from bounds of its operands."""
        node = self._of.nodes[i]
        if node.rule == "sums":
            found = _sums(node, operands)
        elif node.rule == "function":
            assert node.relaxation is not None
            _, operation, parameters = node.relaxation
            found = operation.range_of(*operands, *parameters)
        else:
            found = _result(node, operands, self._of.squares[i])
        self._put(4 + i, *found)

    def _put(self, part: int, low: Array, high: Array) -> None:
        first, last = self._of.first[part : part + 2]
        ends = self._ends[0, :, :, first:last]
        ends[:, 0], ends[:, 1] = high, 0.0 - low
        if not all_finite(ends):
            ends[~np.isfinite(ends)] = math.inf
        np.abs(ends, out=self._ends[1, :, :, first:last])


class _Fold:
    """A combination of intervals.

    The sums, and the coefficients' own errors, are off by at most ``error + combined(terms)`` times the sum of all
    magnitudes. A row that is a basic value, or minus one, is that value's interval: nothing is rounded there. Where no
    term of a sum can be positive, neither is the sum, whatever the rounding: roots and quotients have their ends there.
    """

    def __init__(self, combination: Combination) -> None:
        matrix, sizes = (side.detach().numpy() for side in combination[:2])
        rows = len(matrix)
        copies = np.zeros(rows, bool) if combination.copies is None else combination.copies.numpy()[:, 0]
        used = np.flatnonzero(sizes[:, 1:].any(0)) + 1
        self._first, self._last = (int(used[0]), int(used[-1]) + 1) if len(used) else (0, 0)
        part, size = (side[:, self._first : self._last].T for side in (matrix, sizes))
        up, down = np.maximum(part, 0.0), np.maximum(-part, 0.0)
        self._matrix = np.stack([np.block([[up, down], [down, up]]), np.block([[size, size], [size, size]])])
        constant, its_size = matrix[:, 0], sizes[:, 0]
        self._constant = np.stack([np.r_[constant, -constant], np.r_[its_size, its_size]])[:, None]
        terms = 2 * (self._last - self._first) + 1
        twice = np.r_[copies, copies]
        self._error = np.where(twice, 0.0, (combination.error + combined(terms)) * SAFETY)
        self._tiny = np.where(twice, 0.0, TINY)
        self._signs = combination.error * SAFETY + 2.0**-1000, part, size, constant, its_size

    @functools.cached_property
    def _rising(self) -> Array:
        """Which ends may rise with which ends of the values, ``(2 values, 2 rows)``."""
        doubt, part, size, _, _ = self._signs  # of a coefficient's sign
        rising, falling = ((size > 0) & (sign * part + size * doubt > 0) for sign in (1.0, -1.0))
        return np.block([[rising, falling], [falling, rising]]).astype(float)

    @functools.cached_property
    def _constant_rises(self) -> Array:
        """Which ends the constant may raise, ``(2 rows,)``."""
        doubt, _, _, constant, size = self._signs
        above, below = (sign * constant + size * doubt > 0 for sign in (1.0, -1.0))
        return np.r_[above, below].astype(float)

    def __call__(self, ends: Array) -> Sides:
        """Its bounds."""
        x = ends[..., self._first : self._last].reshape(*ends.shape[:2], -1)
        lost = None
        if not all_finite(x[1]):
            lost = ~np.isfinite(x[0])
            x = np.where(lost, 0.0, x)
        value, size = x @ self._matrix + self._constant
        top = value + (size * self._error + self._tiny)
        crossing = (value <= 0) & (top > 0)
        if crossing.any():
            positive = (x[0] > 0).astype(float) @ self._rising + self._constant_rises
            top = np.where(crossing & (positive == 0), 0.0, top)
        if lost is not None:
            top = np.where(lost.astype(float) @ self._rising > 0, math.inf, top)
        if not all_finite(top):
            top = np.where(np.isfinite(value) & np.isfinite(top), top, math.inf)
        rows = top.shape[-1] // 2
        return 0.0 - top[:, rows:], top[:, :rows]


def _squares(node: Node) -> Array | None:
    """Which entries of a product have one factor twice; None if none has."""
    if node.rule != "product" or not (node.square or node.operands.error == 0):
        return None
    a, b = node.operands.matrix.detach().split(node.size)
    same = (a == b).all(-1).numpy()  # both are exact, or the same
    return same if same.any() else None


def within(bounds: Sides, others: Sides) -> Sides:
    """What holds if both hold; what is no number says nothing."""
    return np.fmax(bounds[0], others[0]), np.fmin(bounds[1], others[1])


def with_form(node: Node, operands: Sides, form: Sides) -> tuple[Sides, Sides]:
    """What a form and intervals say of the operands of an operation, or of the first ones; what is known of all."""
    low, high = (side[:, : form[0].shape[-1]] for side in operands)
    both = within(form, (low, high))
    return both, both if node.rule in ("function", "product") else operands


def _sums(node: Node, operands: Sides) -> Sides:
    """Sums in float32 from intervals of the exact ones and of what was summed."""
    assert node.relaxation is not None
    matrix, bias = (p.numpy() for p in node.relaxation.parameters)
    (low, terms_low), (high, terms_high) = (np.split(side, [node.size], axis=-1) for side in operands)
    return widened(low, high, error_of_sums(sizes_of_sums(terms_low, terms_high, matrix, bias), matrix.shape[-1]))


def _result(node: Node, operands: Sides, squares: Array | None) -> Any:
    """What an operation of two vectors makes of intervals, or a choice between them."""
    n = node.size
    first = 1 if node.rule in ("maximum", "minimum", "logaddexp", "choice") else 0  # the difference comes first
    count = 3 if node.rule == "choice" else 2
    parts = [IntervalForm(*(side[:, i * n : (i + 1) * n] for side in operands)) for i in range(first, first + count)]
    instruction, a = Instruction(_KINDS[node.rule], n), parts[0]
    low, high = evaluate(instruction, parts).bounds
    if squares is None:
        return low, high
    square = evaluate(instruction, [a, a]).bounds
    return np.where(squares, square[0], low), np.where(squares, square[1], high)
