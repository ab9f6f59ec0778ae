"""Forward affine arithmetic over the steps of a recorded loop.

All that is linear between two nonlinear operations is one matrix product (:mod:`.affine.compiled.folding`); what the
nonlinear ones do is in :mod:`.affine.compiled.operations`. On arrays; on tensors where the tube is differentiated, by
constants of the loop's programs, its numbers or the sets.

Of float64 arithmetic is used that sums and products are correctly rounded, in whatever order a sum of products is
taken, with or without fused multiply-add.
"""

from __future__ import annotations

import functools
import itertools
import weakref
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.reachability.affine.compiled.arrays import added, applied, repeated
from sagemp_cli.reachability.affine.compiled.beside import Beside, Sides
from sagemp_cli.reachability.affine.compiled.folding import Combination, Compiled, Node, compiled
from sagemp_cli.reachability.affine.compiled.hints import Hints
from sagemp_cli.reachability.affine.compiled.intervals import Carried, Intervals, with_form, within
from sagemp_cli.reachability.affine.compiled.operations import (
    EVALUATE,
    Bounded,
    Frame,
    Value,
    enclosed,
    sine_and_cosine_operands,
)
from sagemp_cli.reachability.program.loops import RecordedLoop
from sagemp_cli.reachability.program.program import Program
from sagemp_cli.reachability.relaxations.functions import all_finite, functions_of
from sagemp_cli.sets import Box
from sagemp_cli.sets.rounding import TINY, combined
from sagemp_cli.sets.zonotope import Zonotope

Array = np.ndarray | Tensor


class Done(NamedTuple):
    """What a step gave.

    Attributes:
        frame: of the step.
        after: the next state.
        states: the set after it; its box may reach past ``low`` and ``high``.
        low, high: bounds of the next state, ``(B, n)``.
        watched: bounds of control and deviation, ``(B, m)`` each; None unless asked for and said by the loop.
        form: of the same; None unless said by the loop.
        operands: of every operation, bounds of its operand, or the first ones, by form; None where that is
            not known.
        lost: cells ``(B,)`` whose set has no bounds any more, because an operation's domain was left; None if there are
            none.
        used: whether intervals made a difference to the forms of any cell.
    """

    frame: Frame
    after: Value
    states: Zonotope
    low: Array
    high: Array
    watched: Sides | None
    form: Value | None
    operands: Sequence[Sides | None]
    lost: Array | None
    used: bool


class Steps:
    """The steps of a recorded loop, compiled, with their numbers and the disturbance.

    Args:
        loop: what steps.
        disturbance: W, ``(d,)``; or one box for each step and cell, ``(K, B, d)``.
        cells: shape of the batch of cells; the loop's own batch broadcasts to it.
        tensors: whether to compute with tensors.
        watch: whether control and deviation are to be bounded.
    """

    def __init__(
        self, loop: RecordedLoop, disturbance: Box, cells: torch.Size, *, tensors: bool, watch: bool = False
    ) -> None:
        numbers = loop.numbers_in(cells) if len(loop.batch) else loop.numbers[:, None]
        numbers = numbers.flatten(1, -2)
        self._no_cell = np.zeros(cells.numel(), dtype=bool)
        self._watch = watch
        self._ready = [Ready(p, numbers, disturbance, tensors=tensors) for p in loop.programs]

    @property
    def alike(self) -> bool:
        """Whether all are one program."""
        return len(self._ready) == 1

    def by_forms(self, k: int, states: Zonotope, hints: Hints | None = None) -> Done:
        """Step k from a set, with nothing but the affine rules.

        Args:
            k: which step.
            states: the set.
            hints: what is known of the operations.
        """
        return self._taken(k, states, hints)

    def beside_intervals(self, k: int, states: Zonotope, box: Sides, hints: Hints | None = None) -> Done:
        """The same with what intervals know where they make a difference, or where a set would be lost; of arrays.

        Args:
            k: which step.
            states: the set.
            box: bounds of the states besides, ``(B, n)`` each.
            hints: what is known of the operations.
        """
        done = self._taken(k, states, hints, box, Beside(self._no_cell, noticing=True))
        if done.lost is None or done.frame.beside is None:
            return done
        return self._taken(k, states, hints, box, Beside(done.frame.beside.cells | done.lost, noticing=True))

    def kept(self, k: int, states: Zonotope, box: Sides, hints: Hints | None = None) -> Done:
        """The same with what intervals know only in cells whose set would be lost.

        An end that an interval decides has no gradient with respect to what a tube is trained for.
        """
        done = self._taken(k, states, hints)
        if done.lost is None:
            return done
        return self._taken(k, states, hints, box, Beside(done.lost, noticing=False))

    def _taken(
        self, k: int, states: Zonotope, hints: Hints | None, box: Sides | None = None, beside: Beside | None = None
    ) -> Done:
        ready = self.of(k)
        carried = None if box is None or beside is None else ready.carried([k], *box)
        frame = Frame(states, inputs=ready.inputs, own_radius=ready.radius_at(k), hints=hints, beside=beside)
        after, form, operands = ready.evaluate(k, frame, carried)
        following, lost = frame.advanced(after), None
        if not all_finite(after.both):
            m = functions_of(after.both)
            lost = m.isfinite(states.reach).all(-1) & ~m.isfinite(after.both).all(0).all(-1)
            lost = lost if bool(lost.any()) else None
        low, high = following.low, following.high
        watched = None if form is None or not self._watch else frame.bounds(form)
        used = beside is not None and bool(beside.cells.any())
        if carried is not None and beside is not None and beside.noticing:
            low, high = within((low, high), carried.next())
            watched = watched and within(watched, carried.watched())
        return Done(frame, after, following, low, high, watched, form, operands, lost, used)

    def of(self, k: int) -> Ready:
        """The program of step k."""
        return self._ready[k if len(self._ready) > 1 else 0]


class Ready:
    """One program, compiled, with the numbers of all steps."""

    def __init__(self, program: Program, numbers: Tensor, disturbance: Box, *, tensors: bool) -> None:
        laid = _laid(program, tensors)
        step = laid.step
        self._intervals = functools.cache(lambda: Intervals(step, numbers, disturbance))
        self.inputs = step.states + step.disturbances
        radius = disturbance.radius
        ones = radius.new_ones(*radius.shape[:-1], sum(node.size for node in step.nodes))
        self._own_radius = _placed(torch.cat([radius, ones], -1), tensors)

        def fold(combination: _Laid) -> _Fold:
            return _Fold(combination, numbers, disturbance, tensors=tensors)

        self._nodes = [(node, fold(operands)) for node, operands in zip(step.nodes, laid.operands, strict=True)]
        self._pairs = laid.pairs
        self._next = fold(laid.next)
        self._watched = None if laid.watched is None else fold(laid.watched)

    def radius_at(self, k: int) -> Array:
        """Radii of the variables of step k but the states, see :class:`.Frame`."""
        return self._own_radius if self._own_radius.ndim == 1 else self._own_radius[k][:, None]

    def carried(self, steps: Sequence[int], low: Array, high: Array) -> Carried:
        """Intervals of steps from bounds of the states, ``(steps * B, n)``."""
        sides = (side if isinstance(side, np.ndarray) else side.detach().numpy() for side in (low, high))
        return Carried(self._intervals(), steps, *sides)

    def evaluate(self, k: int, frame: Frame, carried: Carried | None) -> tuple[Value, Value | None, list[Sides | None]]:
        """The next state, control and deviation if the loop says them, and the operands of all operations.

        Args:
            k: which step.
            frame: the set before it; what is done is noted there.
            carried: intervals to be carried along.
        """
        results: list[Value] = []
        operands: list[Sides | None] = []
        known: list[Bounded] = []  # of a function whose turn is next
        for i, (node, fold) in enumerate(self._nodes):
            between = None if carried is None else carried.operand(i)
            if between is not None and frame.beside is not None:
                frame.beside.turn(node, between)
            if known:
                results.append(enclosed(node, frame, known.pop()))
            else:
                frame.operand = None
                if i in self._pairs:
                    after, _ = self._nodes[i + 1]
                    first, second = sine_and_cosine_operands(node, after, frame, fold(k, frame, results))
                    results.append(enclosed(node, frame, first))
                    known.append(second)
                else:
                    results.append(EVALUATE[node.rule](node, frame, fold(k, frame, results)))
            operands.append(frame.operand)
            if carried is not None and between is not None:
                if frame.operand is not None:
                    _, between = with_form(node, between, frame.operand)
                carried.know(i, between)
        watched = None if self._watched is None else self._watched(k, frame, results)
        return self._next(k, frame, results), watched, operands

    @property
    def nodes(self) -> list[Node]:
        """The nonlinear operations, in the order of evaluation."""
        return [node for node, _ in self._nodes]


def _placed(tensor: Tensor, tensors: bool) -> Array:
    return tensor if tensors else tensor.detach().numpy()


def _pairs(nodes: Sequence[Node]) -> set[int]:
    """Sines and cosines that a cosine or sine of the same values follows."""

    def same(a: Combination, b: Combination) -> bool:
        width = a.matrix.shape[-1]
        if a.error != b.error or a.matrix.shape[0] != b.matrix.shape[0] or bool(b.sizes[:, width:].any()):
            return False
        return torch.equal(a.matrix, b.matrix[:, :width]) and torch.equal(a.sizes, b.sizes[:, :width])

    def name(node: Node) -> str:
        return "" if node.relaxation is None else node.relaxation.name

    return {
        i
        for i, (a, b) in enumerate(itertools.pairwise(nodes))
        if {name(a), name(b)} == {"sin", "cos"} and same(a.operands, b.operands)
    }


class _LaidStep(NamedTuple):
    """A compiled step, all of it that is the same whatever its numbers and disturbance are."""

    step: Compiled
    operands: list[_Laid]
    pairs: set[int]
    next: _Laid
    watched: _Laid | None


_LAID: weakref.WeakKeyDictionary[Program, tuple[tuple[int, ...], _LaidStep]] = weakref.WeakKeyDictionary()
"""Of programs that are there; each with the versions of its constants, which change if somebody writes into them."""


def _laid(program: Program, tensors: bool) -> _LaidStep:
    """A program's step, compiled once as long as it is there; each time anew where it is differentiated."""
    constants = [c for i in program.instructions for c in i.constants]
    versions = tuple(-1 if c.is_inference() else c._version for c in constants)
    known = _LAID.get(program)
    if known is not None and known[0] == versions and not tensors:
        return known[1]
    step = compiled(program)
    first = step.columns

    def laid(combination: Combination) -> _Laid:
        return _Laid(first, combination, tensors=tensors)

    operands = [laid(node.operands) for node in step.nodes]
    watched = None if step.watched is None else laid(step.watched)
    found = _LaidStep(step, operands, _pairs(step.nodes), laid(step.outputs.next), watched)
    if not tensors and not any(c.requires_grad for c in constants):
        _LAID[program] = versions, found
    return found


class _Laid:
    """A combination by what it is of: 1, the step's numbers, states, disturbances, and each result.

    Attributes:
        of_one, of_numbers, of_disturbance: matrix and sizes ``(2, rows, columns)``; None if nothing is of them.
        of_state, of_results: transposed, as they are used; of results by their index, the latest first.
        direct: coefficients of state and disturbance.
        error: relative.
    """

    def __init__(self, first: Sequence[int], combination: Combination, *, tensors: bool) -> None:
        missing = max(first[4] - combination.matrix.shape[-1], 0)
        sides = [torch.nn.functional.pad(side, (0, missing)) if missing else side for side in combination[:2]]
        some = (sides[1].detach() != 0).any(0).numpy()
        before = np.concatenate([[0], np.cumsum(some)])
        blocks = itertools.takewhile(lambda block: block[1] < len(before), itertools.pairwise(first))
        used = [(i, a, b) for i, (a, b) in enumerate(blocks) if before[b] > before[a]]
        inputs = {i: torch.stack([side[:, a:b] for side in sides]) for i, a, b in used if i < 4}
        self.of_one = torch.stack([side[:, 0] for side in sides])
        self.of_numbers, self.of_disturbance = inputs.get(1), inputs.get(3)
        self.of_state = _placed(inputs[2].mT.contiguous(), tensors) if 2 in inputs else None
        self.of_results = [
            (
                i - 4,
                _placed(sides[0][:, a:b].contiguous(), tensors),
                _placed(torch.stack([side[:, a:b].mT for side in sides]).contiguous(), tensors),
            )
            for i, a, b in reversed(used)
            if i > 3
        ]
        self.direct: Any = None
        if 3 in inputs:
            self.direct = _placed(sides[0][:, first[2] : first[4]].contiguous()[None], tensors)
        elif 2 in inputs or not self.of_results:
            self.direct = _placed(sides[0][:, first[2] : first[3]].contiguous()[None], tensors)
        self.error = combination.error + combined(sum(b - a for _, a, b in used))


class _Fold:
    """A combination, ready for one propagation: what the step's numbers and the disturbance's centre contribute to the
    constants is known for all steps.
    """

    def __init__(self, laid: _Laid, numbers: Tensor, disturbance: Box, *, tensors: bool) -> None:
        linear = torch.nn.functional.linear
        constant, size = laid.of_one
        size = size + TINY
        if laid.of_disturbance is not None:
            w, (matrix, sizes) = disturbance.center, laid.of_disturbance
            constant = constant + linear(w, matrix)
            size = size + linear(w.abs() + disturbance.radius + TINY, sizes)
        if laid.of_numbers is not None:
            matrix, sizes = laid.of_numbers
            constant, size = constant + linear(numbers, matrix), size + linear(numbers.abs(), sizes)
        self._varies = constant.dim() > 1
        stacked = torch.stack([constant, size], dim=1) if self._varies else torch.stack([constant, size])[:, None]
        self._constant = _placed(stacked, tensors)
        self._of_state, self._of_results, self._direct = laid.of_state, laid.of_results, laid.direct
        self._error = laid.error

    def __call__(self, k: int, frame: Frame, results: Sequence[Value]) -> Value:
        """The combination at step k."""
        both = self._constant[k] if self._varies else self._constant
        if self._of_state is not None:
            both = both + frame.both @ self._of_state
        coefficients, error = None, 0.0
        for i, matrix, sided in self._of_results:
            both = both + results[i].both @ sided
            error = max(error, results[i].error)
            coefficients = added(coefficients, applied(matrix, results[i].coefficients, results[i].fresh))
        if coefficients is None:
            coefficients = self._direct
        elif self._direct is not None:
            coefficients = added(coefficients, self._direct)
        if both.shape[1] != frame.both.shape[1]:
            both = repeated(both, frame.both.shape[1], axis=1)
        return Value(both, coefficients, self._error + error)
