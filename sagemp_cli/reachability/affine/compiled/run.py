"""Forward affine arithmetic over the steps of a recorded loop.

All that is linear between two nonlinear operations is one matrix product (:mod:`.affine.compiled.folding`); what the
nonlinear ones do is in :mod:`.affine.compiled.operations`. On arrays; on tensors where the tube is differentiated, by
constants of the loop's programs, its numbers or the sets.

Of float64 arithmetic is used that sums and products are correctly rounded, in whatever order a sum of products is
taken, with or without fused multiply-add.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.reachability.affine.compiled.arrays import added, repeated
from sagemp_cli.reachability.affine.compiled.folding import Combination, Compiled, Node, compiled
from sagemp_cli.reachability.affine.compiled.hints import Hint, Hints
from sagemp_cli.reachability.affine.compiled.operations import (
    EVALUATE,
    Bounded,
    Frame,
    Value,
    enclosed,
    sine_and_cosine_operands,
)
from sagemp_cli.reachability.interval.form import IntervalForm
from sagemp_cli.reachability.interval.operands import operands, sharper
from sagemp_cli.reachability.program.loops import RecordedLoop
from sagemp_cli.reachability.program.program import Program
from sagemp_cli.reachability.relaxations.functions import functions_of
from sagemp_cli.sets import Box
from sagemp_cli.sets.rounding import TINY, combined
from sagemp_cli.sets.zonotope import Zonotope

Array = np.ndarray | Tensor


class Steps:
    """The steps of a recorded loop, compiled, with their numbers and the disturbance.

    Args:
        loop: what steps.
        disturbance: W, ``(d,)``; or one box for each step and cell, ``(K, B, d)``.
        cells: shape of the batch of cells; the loop's own batch broadcasts to it.
        tensors: whether to compute with tensors.
    """

    def __init__(self, loop: RecordedLoop, disturbance: Box, cells: torch.Size, *, tensors: bool) -> None:
        numbers = loop.numbers_in(cells) if len(loop.batch) else loop.numbers[:, None]
        self._numbers = numbers.flatten(1, -2)
        self._disturbance, self._tensors = disturbance, tensors
        self._ready = [_Ready(p, self._numbers, disturbance, tensors=tensors) for p in loop.programs]
        self._varies = disturbance.lower.dim() > 1

    def evaluate(self, k: int, states: Zonotope, hints: Hints | None) -> tuple[Frame, Value, Value | None]:
        """Step k from a set: its frame, the next state, and control and deviation if the loop says them."""
        ready = self._of(k)
        frame = Frame(states, inputs=ready.inputs, own_radius=ready.radius_at(k), hints=hints)
        after, watched = ready.evaluate(k, frame)
        if not math.isfinite(after.both.sum().item()):
            m = functions_of(after.both)
            lost = m.isfinite(states.reach).all(-1) & ~m.isfinite(after.both).all(0).all(-1)
            if bool(lost.any()):  # an operation's domain was left: intervals may know better
                known = sharper(self._operands(k, states), hints, where=torch.as_tensor(lost))
                frame = Frame(states, inputs=ready.inputs, own_radius=ready.radius_at(k), hints=known)
                after, watched = ready.evaluate(k, frame)
        return frame, after, watched

    def _operands(self, k: int, states: Zonotope) -> list[Hint]:
        """What intervals know of step k's operations."""
        low, high = (torch.as_tensor(side).detach() for side in (states.low, states.high))
        numbers = self._numbers[k].detach()
        disturbance = [s[k] if self._varies else s for s in (self._disturbance.lower, self._disturbance.upper)]
        given = ((low, high), disturbance, (numbers, numbers))
        with torch.no_grad():
            return operands(self._of(k).program, *(IntervalForm(*sides) for sides in given))

    def _of(self, k: int) -> _Ready:
        return self._ready[k if len(self._ready) > 1 else 0]


class _Ready:
    """One program, compiled, with the numbers of all steps."""

    def __init__(self, program: Program, numbers: Tensor, disturbance: Box, *, tensors: bool) -> None:
        self.program = program
        step = compiled(program)
        self.inputs = step.states + step.disturbances
        radius = disturbance.radius
        ones = radius.new_ones(*radius.shape[:-1], sum(node.size for node in step.nodes))
        self._own_radius = _placed(torch.cat([radius, ones], -1), tensors)

        def fold(combination: Combination) -> _Fold:
            return _Fold(step, combination, numbers, disturbance, tensors=tensors)

        self._nodes = [(node, fold(node.operands)) for node in step.nodes]
        self._pairs = _pairs(step.nodes)
        self._next = fold(step.outputs.next)
        self._watched = None if step.watched is None else fold(step.watched)

    def radius_at(self, k: int) -> Array:
        """Radii of the variables of step k but the states, see :class:`.Frame`."""
        return self._own_radius if self._own_radius.ndim == 1 else self._own_radius[k][:, None]

    def evaluate(self, k: int, frame: Frame) -> tuple[Value, Value | None]:
        results: list[Value] = []
        known: list[Bounded] = []  # of a function whose turn is next
        for i, (node, fold) in enumerate(self._nodes):
            if known:
                results.append(enclosed(node, frame, known.pop()))
            elif i in self._pairs:
                after, _ = self._nodes[i + 1]
                first, second = sine_and_cosine_operands(node, after, frame, fold(k, frame, results))
                results.append(enclosed(node, frame, first))
                known.append(second)
            else:
                results.append(EVALUATE[node.rule](node, frame, fold(k, frame, results)))
        watched = None if self._watched is None else self._watched(k, frame, results)
        return self._next(k, frame, results), watched


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


class _Fold:
    """A combination, ready for one propagation: what the step's numbers and the disturbance's centre contribute to the
    constants is known for all steps.
    """

    def __init__(
        self, step: Compiled, combination: Combination, numbers: Tensor, disturbance: Box, *, tensors: bool
    ) -> None:
        linear = torch.nn.functional.linear
        matrix, sizes = (step.split(side) for side in combination[:2])
        used = [bool(part.any()) for part in sizes]
        w = disturbance.center
        constant = matrix[0][:, 0] + linear(w, matrix[3])
        size = sizes[0][:, 0] + linear(w.abs() + disturbance.radius + TINY, sizes[3]) + TINY
        self._varies = used[1] or (used[3] and w.dim() > 1)
        if not self._varies and w.dim() > 1:
            constant, size = constant[0, 0], size[0, 0]
        if used[1]:
            constant, size = constant + linear(numbers, matrix[1]), size + linear(numbers.abs(), sizes[1])
        if self._varies:
            self._constant = _placed(torch.stack([constant, size], dim=1), tensors)
        else:
            self._constant = _placed(torch.stack([constant, size])[:, None], tensors)

        def sided(i: int) -> Array:
            return _placed(torch.stack([matrix[i].mT, sizes[i].mT]).contiguous(), tensors)

        self._of_state = sided(2) if used[2] else None
        self._of_results = [
            (i - 4, _placed(matrix[i].contiguous(), tensors), sided(i)) for i in range(len(used) - 1, 3, -1) if used[i]
        ]
        # Coefficients of state and disturbance; results are taken the latest first, which has most variables.
        self._direct: Any = None
        if used[3]:
            self._direct = _placed(torch.cat([matrix[2], matrix[3]], dim=-1)[None], tensors)
        elif used[2] or not self._of_results:
            self._direct = _placed(matrix[2].contiguous()[None], tensors)
        length = sum(part.shape[-1] for part, some in zip(matrix, used, strict=True) if some)
        self._error = combination.error + combined(length)

    def __call__(self, k: int, frame: Frame, results: Sequence[Value]) -> Value:
        """The combination at step k."""
        both = self._constant[k] if self._varies else self._constant
        if self._of_state is not None:
            both = both + frame.both @ self._of_state
        coefficients, error = None, 0.0
        for i, matrix, sided in self._of_results:
            both = both + results[i].both @ sided
            error = max(error, results[i].error)
            coefficients = added(coefficients, matrix @ results[i].coefficients)
        if coefficients is None:
            coefficients = self._direct
        elif self._direct is not None:
            coefficients = added(coefficients, self._direct)
        if both.shape[1] != frame.both.shape[1]:
            both = repeated(both, frame.both.shape[1], axis=1)
        return Value(both, coefficients, self._error + error)
