"""Affine arithmetic in plain float64, for the price of rigour: :mod:`.affine.compiled.run` on the same compiled step,
with the same sums over generators and the same reduction, but without its account of rounding.

Its tubes prove nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.reachability.affine.compiled.arrays import with_fresh
from sagemp_cli.reachability.affine.compiled.folding import Combination, Compiled, Node, compiled
from sagemp_cli.reachability.affine.compiled.operations import Frame
from sagemp_cli.reachability.program.loops import recorded
from sagemp_cli.reachability.propagator import Loop
from sagemp_cli.sets import Box, Tube
from sagemp_cli.sets.rounding import TINY
from sagemp_cli.sets.zonotope import Zonotope

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
    def of(step: Compiled, combination: Combination, given: Tensor, center: Tensor) -> _Fold:
        one, numbers, state, w, *results = step.split(combination.matrix.detach())
        linear = torch.nn.functional.linear
        constants = one[:, 0] + linear(given, numbers) + linear(center, w)
        return _Fold(
            constants.numpy(),
            state.mT.contiguous().numpy(),
            torch.cat([state, w], dim=-1).numpy(),
            tuple((i, m.numpy()) for i, m in reversed([*enumerate(results)]) if m.any()),
            bool(state.any() or w.any()),
        )

    def __call__(self, k: int, frame: Frame, results: Sequence[Form]) -> Form:
        center, coefficients = self.constants[k] + frame.both[0] @ self.of_state, self.of_inputs
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


def _with_fresh(frame: Frame, center: Array, coefficients: Array, radius: Array) -> Form:
    """One new variable per entry."""
    size = frame.size
    frame.size += radius.shape[-1]
    return center, with_fresh(coefficients, 1.0, size, radius)


def _function(node: Node, frame: Frame, x: Form) -> Form:
    radius, how = frame.radius(x[1]), node.relaxation
    assert how is not None
    slope, offset, error = how.operation.band_of(x[0] - radius, x[0] + radius, *how.parameters)
    return _with_fresh(frame, x[0] * slope + offset, x[1] * slope[..., None], error)


def _product(node: Node, frame: Frame, x: Form) -> Form:
    size = node.size
    (c, d), (gx, gy) = (np.split(side, [size], axis=1) for side in x)
    radius = frame.radius(x[1]) + TINY
    ratio = np.sqrt(radius[:, size:] / radius[:, :size])[..., None]
    a, b = gx * ratio, gy / ratio
    ends = frame.radius(np.concatenate([a + b, a - b], axis=1)) ** 2
    high, low = 0.25 * ends[:, :size], 0.25 * ends[:, size:]
    coefficients = c[..., None] * gy + d[..., None] * gx
    return _with_fresh(frame, c * d + 0.5 * (high - low), coefficients, 0.5 * (high + low))


_EVALUATE = {"function": _function, "product": _product}


@torch.no_grad()
@np.errstate(all="ignore")
def propagate(loop: Loop, start: Box, disturbance: Box) -> Tube:
    """The tube of a start box ``(B, n)`` in plain float64; of the operations that the benchmark's loops have."""
    n, known = start.dim, recorded(loop, start, disturbance)
    step = compiled(known.programs[0])
    nodes = [(node, _Fold.of(step, node.operands, known.numbers, disturbance.center)) for node in step.nodes]
    after = _Fold.of(step, step.outputs.next, known.numbers, disturbance.center)
    own_radius = np.concatenate([disturbance.radius.numpy(), np.ones(sum(node.size for node in step.nodes))])
    states = Zonotope(start.center.numpy(), start.radius.numpy()[:, :, None] * np.eye(n))
    lowers, uppers, again = [start.lower.numpy()], [start.upper.numpy()], 0
    for k in range(loop.horizon):
        frame = Frame(states, inputs=n + disturbance.dim, own_radius=own_radius)
        results: list[Form] = []
        for node, fold in nodes:
            results.append(_EVALUATE[node.rule](node, frame, fold(k, frame, results)))
        center, coefficients = after(k, frame, results)
        own = coefficients[..., n:]
        generators = np.concatenate([coefficients[..., :n] @ states.generators, own * own_radius[: own.shape[-1]]], -1)
        states = Zonotope(center, generators)
        if states.order > again:
            states, _ = states.reduce_order()
            again = max(states.order * 5 // 4, states.order + 64)
        radius = np.abs(states.generators).sum(-1)
        lowers.append(center - radius)
        uppers.append(center + radius)
    return Tube(*(torch.from_numpy(np.stack(side, axis=1)) for side in (lowers, uppers)))
