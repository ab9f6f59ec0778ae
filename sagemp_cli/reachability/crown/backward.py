"""The backward pass of CROWN over the steps that a forward pass recorded.

A linear functional (a *row*) of the next state is a functional of the step's variables
(:mod:`.crown.backward_steps`). Backwards, in the reverse order of evaluation, each error ``e_j`` is
replaced by a line over x_j, the upper or the lower one according to the sign of its coefficient; and x_j is a function
of earlier variables. What remains at the end of the step is a functional of the state's deviations ``z``, which is a
row of the previous state. With both lines parallel to the band this is affine arithmetic again; lines chosen by sign
are what CROWN has more.

Everything that does not depend on the rows is done once for all steps: a replacement is one product of a fixed matrix
with the coefficients' positive and negative parts. Rows are the columns of arrays here, so that a variable's
coefficients lie side by side.

Rounding. Each matrix has a row more, with the magnitudes ``|coefficients| |v|`` that pass through it. Their sum T
bounds every intermediate result, so a step errs by at most ``gamma T`` (Higham 2002, section 3.1; gamma from the
lengths of all sums), and that is added to the bound. The computed coefficients are taken as they are: what they differ
from the exact ones by is in it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.reachability.crown.backward_steps import LEAD, Array, Inputs, Product, Replacement, Step
from sagemp_cli.reachability.crown.steps import Extent, Steps
from sagemp_cli.sets.rounding import TINY, at_least, gamma, slack


@dataclass(frozen=True)
class Bounds:
    """What a backward pass found.

    Attributes:
        state: ``(lower, upper)`` of the deviations of the states from their centres per target step,
            ``(B, targets, n)``; None if they were not asked for.
        inputs: the same of each operation's input, per target step and operation, ``(B, E)``; infinite
            for entries, and None for operations, that were not asked for.
    """

    state: tuple[Tensor, Tensor] | None
    inputs: list[list[tuple[Tensor, Tensor] | None]]

    def intersected(self, other: Bounds) -> Bounds:
        """What holds if both hold."""

        def both(a: Any, b: Any) -> Any:
            return None if a is None or b is None else (torch.maximum(a[0], b[0]), torch.minimum(a[1], b[1]))

        inputs = [
            [both(a, b) for a, b in zip(*step, strict=True)] for step in zip(self.inputs, other.inputs, strict=True)
        ]
        return Bounds(both(self.state, other.state), inputs)


@np.errstate(all="ignore")  # what overflows is unbounded
def backward(
    steps: Steps, within: Array, *, targets: range, begin: int = 0, states: bool = True, inputs: bool = False
) -> Bounds:
    """Bounds of the states after the target steps, and of all operations' inputs in these steps.

    Two sweeps, one with tilted and one with level planes over products; neither is always the better one.

    Args:
        steps: all of them.
        within: generators of a set that holds the state's deviations before step ``begin``, ``(B, n, m)``.
        targets: the steps whose results are bounded.
        begin: how far rows go back.
        states: whether the states are bounded.
        inputs: whether the operations' inputs are.
    """
    asked = _Asked(within, targets, begin, states, inputs)
    level = _swept(steps, asked, False)
    if not any(steps.extents[k].products for k in range(begin, targets.stop)):
        return level
    return level.intersected(_swept(steps, asked, True))


class _Asked(NamedTuple):
    """See :func:`backward`."""

    within: Array
    targets: range
    begin: int
    states: bool
    inputs: bool


def _swept(steps: Steps, asked: _Asked, tilted: bool) -> Bounds:
    """All targets go back in one sweep; a target joins when the sweep comes by."""
    sweep, targets = _Sweep(steps.extents, asked), asked.targets
    joined: list[tuple[int, Inputs | None, int]] = []  # step, inputs (None: the state), rows
    for k in range(targets.stop - 1, asked.begin - 1, -1):
        step = steps[k]
        if asked.states and k in targets:
            joined.append((k, None, sweep.join_states()))
        sweep.enter(step)
        for r in reversed(step.replacements):
            if r.coefficients is not None:
                sweep.add(r)
            elif tilted and r.product is not None:
                _tilt(sweep.head(r.first), sweep.scaled(r), r.product, step.shape, step.own)
            else:
                sweep.keep(r)
            if asked.inputs and k in targets and r.inputs is not None:
                joined.append((k, r.inputs, sweep.join(r.inputs)))
        sweep.leave(step.rounding)
    return _collected(sweep.upper(), joined, targets, steps.extents)


class _Sweep:
    """The rows on their way, as columns of arrays that are made once.

    Args:
        extents: of the steps.
        asked: what is bounded.
    """

    def __init__(self, extents: Sequence[Extent], asked: _Asked) -> None:
        cells, n, _ = asked.within.shape
        most = 2 * n * len(asked.targets) if asked.states else 0
        if asked.inputs:
            most += sum(extents[k].inputs for k in asked.targets)
        passed = extents[asked.begin : asked.targets.stop]
        width, widest = max(e.height for e in passed), max(e.widest for e in passed)
        self._within, self._count = asked.within, 0
        self._constant, self._states = np.empty((cells, most)), np.empty((cells, n, most))
        self._values, self._scratch = np.empty((2, cells, width, most))
        self._parts = np.empty((cells, 2 * max(n, widest), most))

    def join_states(self) -> int:
        """Rows of the state itself, and of minus it; how many."""
        n = self._states.shape[-2]
        here = slice(self._count, self._count + 2 * n)
        self._constant[:, here] = 0.0
        self._states[..., here] = np.concatenate([np.eye(n), -np.eye(n)], axis=-1)
        self._count += 2 * n
        return 2 * n

    def enter(self, step: Step) -> None:
        """Rows of the next state as rows of the step's variables."""
        parts = self._split(self._states[..., : self._count])
        np.matmul(step.output, parts, out=self._values[:, : step.output.shape[-2], : self._count])

    def head(self, first: int) -> Array:
        """Gain, magnitude, and the coefficients of the first variables; may be changed."""
        return self._values[:, : LEAD + first, : self._count]

    def scaled(self, r: Replacement) -> Array:
        """Positive and negative parts of a replacement's coefficients, in units of the errors themselves."""
        assert r.inverse is not None
        return self._split(self._values[:, LEAD + r.first : LEAD + r.last, : self._count] * r.inverse)

    def add(self, r: Replacement) -> None:
        """What lines make of a replacement's coefficients: of each only one part is not 0, and one line is taken."""
        assert r.coefficients is not None and r.lead is not None and r.tilts is not None
        parts, (upper, lower) = self.scaled(r), r.tilts
        lead = self._values[:, :LEAD, : self._count]
        lead += r.lead @ parts
        tilted, negative = np.split(parts, 2, axis=-2)
        tilted *= upper
        negative *= lower
        tilted += negative
        first = r.coefficients.shape[-2]
        made = np.matmul(r.coefficients, tilted, out=self._scratch[:, :first, : self._count])
        head = self._values[:, LEAD : LEAD + first, : self._count]
        np.add(head, made, out=head)

    def keep(self, r: Replacement) -> None:
        """Variables of which only their radius is used."""
        size = np.abs(self._values[:, LEAD + r.first : LEAD + r.last, : self._count])
        self._values[:, :LEAD, : self._count] += r.radius @ size

    def join(self, inputs: Inputs) -> int:
        """Rows of an operation's inputs; how many."""
        height, count = inputs.rows.shape[-2:]
        here = slice(self._count, self._count + count)
        self._constant[:, here] = 0.0
        self._values[:, :height, here] = inputs.rows
        self._count += count
        return count

    def leave(self, rounding: float) -> None:
        """Rows of the step's variables, all but the state's replaced, as rows of the state."""
        n, lead = self._states.shape[-2], self._values[:, :LEAD, : self._count]
        gain = lead[:, 0] + (rounding * lead[:, 1] + TINY)
        constant = self._constant[:, : self._count]
        constant += gain
        constant += slack(np.abs(constant) + np.abs(gain), 4)
        self._states[..., : self._count] = self._values[:, LEAD : LEAD + n, : self._count]

    def upper(self) -> Array:
        """Upper bounds of all rows over the set that they went back to, ``(B, rows)``; infinite where unknown."""
        n, count = self._within.shape[-2:]
        reach = np.zeros_like(self._constant)
        for first in range(0, reach.shape[-1], _ROWS):
            rows = slice(first, first + _ROWS)
            reach[:, rows] = np.abs(self._within.mT @ self._states[..., rows]).sum(-2)
        # A product of a generator and a row is off by its n roundings of the sizes of its terms.
        sizes = (np.abs(self._within).sum(-1)[:, None] @ np.abs(self._states))[:, 0] * at_least(n + count)
        reach = (reach + slack(sizes, n + 2)) * at_least(n + count)
        upper = self._constant + reach
        upper += slack(np.abs(upper) + reach, 4)
        return np.nan_to_num(upper, nan=math.inf, posinf=math.inf, neginf=math.inf)

    def _split(self, rows: Array) -> Array:
        """Positive and negative parts one after the other, both not negative; valid until the next call."""
        return _split(rows, self._parts[:, : 2 * rows.shape[-2], : self._count])


_ROWS = 1024
"""Rows that are bounded at once."""


def _split(rows: Array, out: Array) -> Array:
    """Positive and negative parts one after the other, both not negative."""
    entries = rows.shape[-2]
    np.maximum(rows, 0.0, out=out[:, :entries])
    np.subtract(out[:, :entries], rows, out=out[:, entries:])
    return out


def _tilt(head: Array, parts: Array, product: Product, shape: Array, own: Array) -> None:
    """Replace the error of a product ``X Y`` by a plane, tilted so that it is low where the row is large.

    ``X Y = (P^2 - M^2) / 4`` with ``|P| <= p``, ``|M| <= m`` and ``|P| + |M| <= 2 s``. For every tilt ``|a| <= s`` the
    excess over ``a M`` is at most ``p^2 / 4 + a^2`` if ``2 |a| <= q = min(m, 2 s - p)``, and
    ``p^2 / 4 - q^2 / 4 + |a| q`` otherwise: ``P^2`` is at its largest for ``|M| <= 2 s - p``, and beyond that the
    boundary ``|P| = 2 s - |M|`` makes the excess linear, falling outwards. For independent factors (p = m = 2 s) and
    ``a = +-s`` these are McCormick's planes, for ``a = 0`` the band of affine arithmetic. Below it is the same with P
    and M exchanged.

    Where the row is large is a guess, the state set being taken for an ellipsoid.

    Args:
        head: gain, magnitude, and coefficients of the variables before; changed.
        parts: of the coefficients, upper bounds' first.
        product, shape, own: of the step.
    """
    n = shape.shape[-1]
    rows = head[:, LEAD:]
    state = rows[:, :n]
    star = product.likely @ state
    star /= np.sqrt(np.add.reduce((shape @ state) * state, axis=-2, keepdims=True)) + TINY
    star += product.tilts[..., n:] @ (np.sign(rows[:, n:]) * own[: rows.shape[-2] - n])
    star = np.nan_to_num(star, copy=False)
    steep = np.abs(star)
    inside = steep <= product.free
    steep = np.where(inside, 0.5 * steep, product.size)
    cost = np.where(2 * steep <= product.free, steep * steep, (steep - 0.25 * product.free) * product.free)
    cost += product.top
    cost *= parts * (1.0 + gamma(16))
    size = parts * steep
    head[:, 0] += np.add.reduce(cost + parts * product.offset + size * product.rounding, axis=-2)
    head[:, 1] += np.add.reduce(cost + parts * product.middle + size * product.magnitude, axis=-2)
    rows += product.tilts.mT @ np.copysign(size, -star)


def _collected(
    upper: Array,
    joined: Sequence[tuple[int, Inputs | None, int]],
    targets: range,
    extents: Sequence[Extent],
) -> Bounds:
    """Upper bounds of rows and of minus the rows, as lower and upper bounds by step and operation."""
    states: list[Any] = [None] * len(targets)
    found: list[list[Any]] = [[None] * len(extents[k].entries) for k in targets]
    begin = 0
    for k, inputs, count in joined:
        high, low = np.split(upper[:, begin : begin + count], 2, axis=-1)
        begin += count
        if inputs is None:
            states[k - targets.start] = (-low, high)
            continue
        lower = np.full((len(upper), extents[k].entries[inputs.operations[0]]), -math.inf)
        higher = -lower
        lower[:, inputs.entries], higher[:, inputs.entries] = -low, high
        bounds = tuple(torch.from_numpy(side) for side in (lower, higher))
        for operation in inputs.operations:
            found[k - targets.start][operation] = bounds
    if None in states:
        return Bounds(None, found)
    lower, higher = (torch.from_numpy(np.stack(side, axis=1)) for side in zip(*states, strict=True))
    return Bounds((lower, higher), found)
