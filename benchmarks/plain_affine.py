"""Affine arithmetic in plain float64, for the price of rigour: :mod:`.affine.compiled.run` on the same
plan, with the same sums over generators and the same reduction, but without its account of rounding.

Its tubes prove nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.reachability.affine.compiled.foldable_loop import FoldableLoop
from sagemp_cli.reachability.affine.compiled.folding import Combination, Node, Plan, plan_of
from sagemp_cli.reachability.affine.compiled.operations import States, diagonal
from sagemp_cli.sets import Box, Tube
from sagemp_cli.sets.order_reduction import reduce_arrays
from sagemp_cli.sets.rounding import TINY

Array = np.ndarray
Form = tuple[Array, Array]
"""Centre ``(B, e)`` and coefficients ``(B, e, variables)``."""


@dataclass(frozen=True)
class _Fold:
    """A combination with its numbers: constants per step, and matrices of the state, of w and of results;
    whether the former are not zero."""

    constants: Array
    of_state: Array
    of_inputs: Array
    of_results: tuple[tuple[int, Array], ...]
    direct: bool

    @staticmethod
    def of(plan: Plan, combination: Combination, given: Tensor, center: Tensor) -> _Fold:
        one, numbers, state, w, *results = plan.split(combination.matrix.detach())
        linear = torch.nn.functional.linear
        constants = one[:, 0] + linear(given, numbers) + linear(center, w)
        return _Fold(
            constants.numpy(),
            state.mT.contiguous().numpy(),
            torch.cat([state, w], dim=-1).numpy(),
            tuple((i, m.numpy()) for i, m in reversed([*enumerate(results)]) if m.any()),
            bool(state.any() or w.any()),
        )

    def __call__(self, k: int, states: States, results: Sequence[Form]) -> Form:
        center, coefficients = self.constants[k] + states.both[0] @ self.of_state, self.of_inputs
        for i, matrix in self.of_results:  # the latest first, which has most variables
            center = center + results[i][0] @ matrix.T
            part = matrix @ results[i][1]
            if coefficients is self.of_inputs:
                coefficients = part
            else:
                coefficients[..., : part.shape[-1]] += part
        if coefficients is not self.of_inputs and self.direct:
            coefficients[..., : self.of_inputs.shape[-1]] += self.of_inputs
        return center, coefficients if coefficients.ndim == 3 else coefficients[None]


def _with_fresh(states: States, center: Array, coefficients: Array, radius: Array) -> Form:
    """One new variable per entry."""
    size = radius.shape[-1]
    out = np.zeros((len(center), size, states.size + size))
    out[..., : coefficients.shape[-1]] = coefficients
    diagonal(out, states.size)[...] = radius
    states.size += size
    return center, out


def _scalar(node: Node, states: States, x: Form) -> Form:
    radius, operation = states.radius(x[1]), node.operation
    assert operation is not None
    slope, offset, error = operation.band_of_arrays(x[0] - radius, x[0] + radius, *node.parameters)
    return _with_fresh(states, x[0] * slope + offset, x[1] * slope[..., None], error)


def _product(node: Node, states: States, x: Form) -> Form:
    size = node.size
    (c, d), (gx, gy) = (np.split(side, [size], axis=1) for side in x)
    radius = states.radius(x[1]) + TINY
    ratio = np.sqrt(radius[:, size:] / radius[:, :size])[..., None]
    a, b = gx * ratio, gy / ratio
    ends = states.radius(np.concatenate([a + b, a - b], axis=1)) ** 2
    high, low = 0.25 * ends[:, :size], 0.25 * ends[:, size:]
    coefficients = c[..., None] * gy + d[..., None] * gx
    return _with_fresh(states, c * d + 0.5 * (high - low), coefficients, 0.5 * (high + low))


_EVALUATE = {"scalar": _scalar, "product": _product}


@torch.no_grad()
@np.errstate(all="ignore")
def propagate(loop: FoldableLoop, start: Box, disturbance: Box) -> Tube:
    """The tube of a start box ``(B, n)`` in plain float64; of the operations that the benchmark's loops have."""
    n, steps = start.dim, loop.horizon
    given = torch.stack([loop.given(k) for k in range(steps)]).flatten(1).to(torch.float64)
    plan = plan_of(loop, loop.given(0).shape, n, disturbance.dim)
    nodes = [(node, _Fold.of(plan, node.operands, given, disturbance.center)) for node in plan.nodes]
    state = _Fold.of(plan, plan.state, given, disturbance.center)
    own_radius = np.concatenate([disturbance.radius.numpy(), np.ones(sum(node.size for node in plan.nodes))])
    center, generators = start.center.numpy(), start.radius.numpy()[:, :, None] * np.eye(n)
    lowers, uppers, again = [start.lower.numpy()], [start.upper.numpy()], 0
    for k in range(steps):
        states = States(center, center, generators, inputs=n + disturbance.dim, own_radius=own_radius)
        results: list[Form] = []
        for node, fold in nodes:
            results.append(_EVALUATE[node.kind](node, states, fold(k, states, results)))
        center, coefficients = state(k, states, results)
        generators = states.rows(coefficients)
        if generators.shape[-1] > again:
            generators, _ = reduce_arrays(generators)
            again = max(generators.shape[-1] * 5 // 4, generators.shape[-1] + 64)
        radius = np.abs(generators).sum(-1)
        lowers.append(center - radius)
        uppers.append(center + radius)
    return Tube(*(torch.from_numpy(np.stack(side, axis=1)) for side in (lowers, uppers)))
