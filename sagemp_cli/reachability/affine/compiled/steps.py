"""The steps of a planned run as affine forms, for a backward pass.

Every step of a plan has the same operations, so each number is turned into tensors once for all steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.reachability.affine.compiled.operations import Record, States, Value
from sagemp_cli.reachability.affine.form import AffineForm, Factors, Relaxed, StepFrame
from sagemp_cli.reachability.relaxations.arctangent2 import Turn
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.sets.rounding import TINY

Array = np.ndarray


class KeptStep(NamedTuple):
    """A step without its generators, which would be most of it.

    Attributes:
        records, size, reach: as for :class:`~sagemp_cli.reachability.affine.compiled.operations.States`.
        ellipsoid: as for :class:`~sagemp_cli.reachability.affine.form.StepFrame`, ``(B, n, n)``.
        after: the next state.
    """

    records: list[Record]
    size: int
    reach: Array
    ellipsoid: Array
    after: Value

    @staticmethod
    def of(states: States, after: Value) -> KeptStep:
        """What is kept of a step."""
        square = states.generators @ np.swapaxes(states.generators, -1, -2)
        scale = states.reach / (np.sqrt(np.diagonal(square, axis1=-2, axis2=-1)) + TINY)
        ellipsoid = square * scale[..., None] * scale[..., None, :]
        return KeptStep(states.records, states.size, states.reach, ellipsoid, after)


def forms_of(steps: Sequence[KeptStep], batch: torch.Size, disturbance_radius: Tensor) -> list[AffineForm]:
    """The next state after every step, and in its frame what went into it.

    Args:
        steps: of one plan.
        batch: shape of the batch that the cells are.
        disturbance_radius: ``(d,)``.
    """
    if not steps:
        return []
    turn = _Turn(len(steps), batch)
    reach = turn.vectors([step.reach for step in steps])
    ellipsoids = turn.vectors([step.ellipsoid for step in steps])
    operations = [turn.relaxed(group) for group in zip(*(step.records for step in steps), strict=True)]
    centers, magnitudes = (turn.vectors([step.after.both[i] for step in steps]) for i in range(2))
    width = max(step.after.coefficients.shape[-1] for step in steps)
    coefficients = turn.coefficients([step.after.coefficients for step in steps], steps[0].size - width)
    frames = [StepFrame(r[..., None][..., :0], r, disturbance_radius) for r in reach]
    for k, (frame, step) in enumerate(zip(frames, steps, strict=True)):
        frame.size = step.size
        frame.relaxations = [operation[k] for operation in operations]
        frame.ellipsoid = ellipsoids[k]
    errors = [step.after.error for step in steps]
    return list(map(AffineForm, frames, centers, coefficients, magnitudes, errors))


class _Turn:
    """From arrays with the cells first, one per step, to tensors in the batch shape, one per step."""

    def __init__(self, count: int, batch: torch.Size) -> None:
        self._count, self._batch = count, batch

    def vectors(self, arrays: Sequence[Array]) -> Sequence[Tensor]:
        """``(B, ...)`` as ``(*batch, ...)``."""
        return torch.from_numpy(np.array(arrays)).reshape(self._count, *self._batch, *arrays[0].shape[1:]).unbind()

    def coefficients(self, arrays: Sequence[Array], missing: int = 0) -> Sequence[Tensor]:
        """``(B, e, variables)`` or ``(1, e, variables)`` as ``(variables + missing, *batch, e)``, zeros at the end."""
        stacked = torch.from_numpy(np.array(arrays))
        if missing:
            stacked = torch.nn.functional.pad(stacked, (0, missing))
        stacked = stacked.expand(-1, math.prod(self._batch), -1, -1)
        return stacked.reshape(self._count, *self._batch, *stacked.shape[2:]).movedim(-1, 1).unbind()

    def relaxed(self, group: Sequence[Record]) -> list[Relaxed]:
        """One operation in all steps."""
        r, node = group[0], group[0].node

        def vectors(number: Callable[[Record], Array]) -> Sequence[Tensor]:
            return self.vectors([number(q) for q in group])

        bands = map(Band, *(vectors(lambda q, i=i: q.band[i]) for i in range(3)))
        nothing: Sequence[None] = [None] * self._count
        lower: Sequence[Tensor | None] = nothing
        upper, factors = lower, nothing
        if node is not None:
            lower, upper = vectors(lambda q: q.lower), vectors(lambda q: q.upper)
        if r.factors:
            parts = [self.coefficients([q.factors[i] for q in group]) for i in range(2)]
            parts += [vectors(lambda q, i=i: q.factors[i]) for i in range(2, len(r.factors))]
            factors = list(map(Factors, *parts))
        given = zip(*(vectors(lambda q, i=i: q.given[i]) for i in range(len(r.given))), strict=True)
        turns = map(Turn, *(vectors(lambda q, i=i: q.turn[i]) for i in range(3))) if r.turn else nothing
        operation, parameters = (None, ()) if node is None else (node.operation, node.parameters)
        numbers = zip(
            bands,
            vectors(lambda q: q.radius),
            *(vectors(lambda q, i=i: q.form.both[i]) for i in range(2)),
            self.coefficients([q.form.coefficients for q in group]),
            lower,
            upper,
            factors,
            given if r.given else [()] * self._count,
            turns,
            strict=True,
        )
        return [
            Relaxed(
                *(r.name, band, radius, r.first, center, coefficients, magnitude, r.form.error),
                *(low, high, operation, parameters, factor, more, turn),
            )
            for band, radius, center, magnitude, coefficients, low, high, factor, more, turn in numbers
        ]
