"""The recorded steps, made ready for rows block by block: as many as a limit allows are kept so, others anew each time.

Ready for rows (:mod:`.crown.backward_steps`), a step takes several times the memory that its record takes, and while it
is made so, several times that: for two layers of 256 neurons and 100 steps, over half a GB a cell. What a sweep does
with a step costs far more than making it ready, so it may as well be made ready again by every sweep.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from sagemp_cli.reachability.affine.compiled.steps import KeptStep
from sagemp_cli.reachability.crown.backward_steps import Step, ready
from sagemp_cli.reachability.propagator import NUMBER

KEPT = 2**27
"""Bytes of the steps that are kept ready, at most."""

BLOCK = 2**25
"""Bytes that making a block of steps ready may take; of one step, if it takes more."""

MAKING = 8
"""Numbers that it takes to make a step ready, per square of its variables, at most."""


class Extent(NamedTuple):
    """How large a step is.

    Attributes:
        height: rows of its variables, lead included.
        widest: variables of the operation that has most.
        inputs: rows of the operations' inputs, to be bounded.
        entries: of each operation, ``(E,)`` of all.
        products: whether it has planes over products.
    """

    height: int
    widest: int
    inputs: int
    entries: tuple[int, ...]
    products: bool

    @staticmethod
    def of(step: Step) -> Extent:
        """Of a step."""
        replacements = step.replacements
        return Extent(
            step.output.shape[-2],
            max((r.last - r.first for r in replacements), default=0),
            sum(r.inputs.rows.shape[-1] for r in replacements if r.inputs is not None),
            step.entries,
            any(r.product is not None for r in replacements),
        )


class Steps:
    """Steps ready for rows, by their number.

    Args:
        recorded: by a forward pass, step 0 first.

    Attributes:
        extents: of all steps.
    """

    def __init__(self, recorded: Sequence[KeptStep]) -> None:
        cells, n, _ = recorded[0].ellipsoid.shape
        making = MAKING * NUMBER * max(1, cells) * max(n + len(s.own_radius) for s in recorded) ** 2
        self._recorded, self._length = recorded, max(1, BLOCK // making)
        self._kept: dict[int, list[Step]] = {}  # by block; the first ones, which every sweep comes by
        self._last = (-1, [])
        self.extents: list[Extent] = []
        room = KEPT
        for block in range(-(-len(recorded) // self._length)):
            steps = self._made(block)
            self.extents += map(Extent.of, steps)
            room -= sum(array.nbytes for array in _arrays(steps))
            if room >= 0:
                self._kept[block] = steps

    def __len__(self) -> int:
        return len(self._recorded)

    def __getitem__(self, k: int) -> Step:
        block, place = divmod(k, self._length)
        return (self._kept.get(block) or self._made(block))[place]

    def _made(self, block: int) -> list[Step]:
        if self._last[0] != block:
            self._last = (-1, [])  # goes before the next one comes
            first = block * self._length
            self._last = (block, ready(self._recorded[first : first + self._length]))
        return self._last[1]


def _arrays(value: object) -> Iterator[np.ndarray]:
    """All arrays in nested tuples and lists."""
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, (tuple, list)):
        for part in value:
            yield from _arrays(part)
