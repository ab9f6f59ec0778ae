"""Forward affine arithmetic on arrays: what :class:`~.affine.affine.Affine` does to a foldable loop.

The enclosures are those of :mod:`sagemp_cli.reachability.affine.form`, with the same variables in the same order, the
same account of rounding and the same records. But all that is linear between two nonlinear operations is one matrix
product (:mod:`.affine.compiled.folding`), and arrays take the place of tensors: on the few numbers of a step an
operation of numpy costs a fifth of one of torch. Not differentiable.

Of float64 arrays is used that sums and products are correctly rounded, in whatever order a sum of products is taken,
with or without fused multiply-add.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.reachability.affine.boxed import Boxed
from sagemp_cli.reachability.affine.compiled.foldable_loop import FoldableLoop, NotFoldable
from sagemp_cli.reachability.affine.compiled.folding import Combination, Node, Plan, plan_of
from sagemp_cli.reachability.affine.compiled.operations import (
    EVALUATE,
    Bounded,
    States,
    Value,
    diagonal,
    enclosed,
    sine_and_cosine_operands,
)
from sagemp_cli.reachability.affine.compiled.steps import KeptStep, forms_of
from sagemp_cli.reachability.affine.form import SAFETY, AffineForm, Hints
from sagemp_cli.reachability.interval.operands import sharper
from sagemp_cli.reachability.recording import recorded_bands
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.sets import Box, Tube
from sagemp_cli.sets.order_reduction import reduce_arrays
from sagemp_cli.sets.rounding import TINY, UNIT

Array = np.ndarray


@dataclass
class PlannedRun:
    """What a forward pass found: see :class:`~sagemp_cli.reachability.affine.affine.AffineRun`.

    Attributes:
        controls: per step, bounds of the control; empty unless asked for.
    """

    tube: Tube
    bands: list[list[tuple[str, Band]]]
    kept: list[Tensor]
    steps: list[AffineForm]
    controls: list[tuple[Tensor, Tensor]]
    notes: tuple[str, ...] = ()


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

    def in_batch(array: Array) -> Tensor:
        return torch.from_numpy(array).reshape((*batch, *array.shape[1:]))

    low, high = (side.reshape(-1, n).numpy() for side in (start.lower, start.upper))
    center, reach = (side.reshape(-1, n).numpy() for side in (start.center, start.radius))
    generators = reach[:, :, None] * np.eye(n)
    lowers, uppers, found = [low], [high], PlannedRun(Tube(start.lower, start.upper), [], [], [], [])
    kept_steps, again, boxed = [], 0, Boxed(symbols)
    for k in range(steps):
        known = None if hints is None else hints[k]
        states = States(center, reach, generators, inputs=plan.inputs, own_radius=plan.own_radius, hints=known)
        after, control = plan.step(k, states)
        lost = np.isfinite(reach).all(-1) & ~np.isfinite(after.both).all((0, 2))
        if lost.any():  # an operation's domain was left: intervals may know better
            box = in_batch(lowers[-1]), in_batch(uppers[-1])
            known = sharper(plan.step_on_sets(k), box, disturbance, known, where=in_batch(lost))
            states = States(center, reach, generators, inputs=plan.inputs, own_radius=plan.own_radius, hints=known)
            after, control = plan.step(k, states)
        kept = (pair for r in states.records for pair in recorded_bands(r.name, r.band, r.turn))
        found.bands.append([(name, Band(*map(in_batch, band))) for name, band in kept])
        if watch and control is not None:
            found.controls.append(tuple(map(in_batch, states.bounds(control))))
        if keep_steps:
            kept_steps.append(KeptStep.of(states, after))
        center, generators = after.both[0], states.rows(after.coefficients, extra=n)
        diagonal(generators, generators.shape[-1] - n)[...] = after.both[1] * (
            (after.error + (2 * n + 16) * UNIT) * SAFETY
        )
        every, count, mask = generators, generators.shape[-1], None
        if count > (again if symbols is None else max(symbols, n + 1)):
            generators, mask = reduce_arrays(generators, symbols)
            again = max(generators.shape[-1] * 5 // 4, generators.shape[-1] + 64)
        if mask is None:
            found.kept.append(torch.ones(count, dtype=torch.bool))
        else:
            found.kept.append(torch.from_numpy(mask) if mask.ndim == 1 else in_batch(mask))
        boxed.follow(every, mask)
        reach = np.add.reduce(np.abs(generators), axis=-1) * (1.0 + 2 * (generators.shape[-1] + 8) * UNIT)
        spread = reach * (1.0 + 2 * UNIT) + np.abs(center) * (2 * UNIT)
        lowers.append(center - spread)
        uppers.append(center + spread)
        if not math.isfinite(reach.sum()):
            bad = ~np.isfinite(reach).all(-1)
            lowers[-1][bad], uppers[-1][bad] = -math.inf, math.inf
            center[bad], generators[bad], reach[bad] = math.nan, math.nan, math.nan
    found.notes = boxed.notes()
    found.steps += forms_of(kept_steps, batch, disturbance.radius)
    found.tube = Tube(*(in_batch(np.stack(side, axis=1)) for side in (lowers, uppers)))
    return found


class _Prepared:
    """A plan with its numbers."""

    def __init__(self, loop: FoldableLoop, steps: int, batch: torch.Size, n: int, disturbance: Box) -> None:
        self._loop = loop
        given = torch.stack([loop.given(k) for k in range(steps)]).to(torch.float64)
        own = given.shape[1 : given.dim() - loop.given_dim]
        shape = given.shape[1 + len(own) :]
        if len(own) > len(batch) or np.broadcast_shapes(own, batch) != batch:
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

    def step_on_sets(self, k: int) -> Callable[[Any, Any], Any]:
        """The step as it is, on value types."""
        return lambda x, w: self._loop.step_given(self._loop.given(k), x, w)

    def step(self, k: int, states: States) -> tuple[Value, Value | None]:
        """The next state, and the control if the loop has one."""
        results: list[Value] = []
        known: list[Bounded] = []  # of a function whose turn is next
        for i, (node, fold) in enumerate(self._nodes):
            if known:
                results.append(enclosed(node, states, known.pop()))
            elif i in self._pairs:
                first, second = sine_and_cosine_operands(node, states, fold(k, states, results))
                results.append(enclosed(node, states, first))
                known.append(second)
            else:
                results.append(EVALUATE[node.kind](node, states, fold(k, states, results)))
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

    def __call__(self, k: int, states: States, results: Sequence[Value]) -> Value:
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
        return Value(both, coefficients, self._error + error)
