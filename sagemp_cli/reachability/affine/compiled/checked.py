"""What intervals know of steps that were taken by forms alone: many steps at once, afterwards.

Where feedback keeps hold of a loop its forms are tighter than intervals throughout, and intervals carried along would
only cost time. So a block of steps is taken without, and then its intervals are computed in one go from the boxes of
its states: that takes little longer than one step. A box that they narrow is kept narrower, and intervals of the step
after it are computed again from there, one step after the other until nothing is narrowed. In the end every box lies in
what intervals make of the box before, so no tube is wider than by intervals alone. Where an operand is noticeably
tighter (:mod:`.beside`) the step is to be taken again, beside its intervals.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sagemp_cli.reachability.affine.compiled.beside import Sides, noticeably
from sagemp_cli.reachability.affine.compiled.intervals import with_form, within
from sagemp_cli.reachability.affine.compiled.run import Steps

NOTHING = 1e-11
"""How much tighter than a form an interval may be by rounding, relative to the values."""


class Trace(NamedTuple):
    """What is kept of a step until it is checked.

    Attributes:
        before: bounds of the states before, by their forms, ``(B, n)`` each; of the first step the best that is known.
        operands: of every operation, bounds of its operand, or the first ones, by form; None where that is
            not known.
        after: bounds of the next state.
        lost: whether a set was lost.
    """

    before: Sides
    operands: Sequence[Sides | None]
    after: Sides
    lost: bool


class Checked(NamedTuple):
    """What is known of steps, once intervals have been asked.

    Attributes:
        steps: how many of them stand; the next one, if there is one, is to be taken again beside its intervals.
        rows: bounds of the state after each of these, ``(B, n)`` each.
        watched: bounds of control and deviation, ``(B, m)`` each; none unless asked for.
    """

    steps: int
    rows: Sequence[Sides]
    watched: Sequence[Sides]


def checked(steps: Steps, first: int, traces: Sequence[Trace], *, watch: bool) -> Checked:
    """Steps that were taken by forms alone, the first of which is step ``first``."""
    count, cells = len(traces), len(traces[0].before[0])
    low, high = (np.stack(side) for side in zip(*(t.before for t in traces), strict=True))
    known = _Known(steps, first, traces, watch=watch)
    rows: list[Sides] = []
    watched: list[Sides] = []
    if steps.alike:
        known.find(range(count), low.reshape(count * cells, -1), high.reshape(count * cells, -1))
    narrowed = not steps.alike
    for i, trace in enumerate(traces):
        if narrowed:
            before = rows[-1] if rows else trace.before
            known.find(range(i, i + 1), *before)
        if trace.lost or known.noticed[i]:
            break
        narrowed = known.narrowed[i] or not steps.alike
        rows.append(known.rows[i])
        if watch:
            watched.append(known.watched[i])
    return Checked(len(rows), rows, watched)


class _Known:
    """What intervals know of each of some steps."""

    def __init__(self, steps: Steps, first: int, traces: Sequence[Trace], *, watch: bool) -> None:
        self._steps, self._first, self._traces, self._watch = steps, first, traces, watch
        self.noticed = [False] * len(traces)
        self.narrowed = [False] * len(traces)
        self.rows: list[Sides] = [trace.after for trace in traces]
        self.watched: list[Sides] = []

    def find(self, which: range, low: np.ndarray, high: np.ndarray) -> None:
        """Ask intervals of steps of one program, from bounds of the states before, ``(steps * B, n)``."""
        ready, traces = self._steps.of(self._first + which[0]), [self._traces[i] for i in which]
        carried = ready.carried([self._first + i for i in which], low, high)
        noticed = np.zeros(len(low), dtype=bool)
        for i, node in enumerate(ready.nodes):
            operands = carried.operand(i)
            if traces[0].operands[i] is not None:
                form = _together([t.operands[i] for t in traces])
                both, operands = with_form(node, operands, form)
                noticed |= noticeably(node, *form, *both)
            carried.know(i, operands)
        after, found = _together([t.after for t in traces]), carried.next()
        narrowed, rows = _tighter(after, found), within(after, found)
        self._put(rows, which, self.rows)
        if self._watch:
            self.watched = self.watched or list(self.rows)
            self._put(carried.watched(), which, self.watched)
        for flags, all_flags in ((noticed, self.noticed), (narrowed, self.narrowed)):
            all_flags[which.start : which.stop] = [bool(f.any()) for f in flags.reshape(len(which), -1)]

    @staticmethod
    def _put(sides: Sides, which: range, into: list[Sides]) -> None:
        low, high = (side.reshape(len(which), -1, side.shape[-1]) for side in sides)
        into[which.start : which.stop] = zip(low, high, strict=True)


def _together(sides: Sequence[Sides | None]) -> Sides:
    """Of several steps, one after the other."""
    first, second = (np.concatenate(side) for side in zip(*(s for s in sides if s is not None), strict=True))
    return first, second


def _tighter(form: Sides, interval: Sides) -> np.ndarray:
    """In which cells the interval has an end inside of the form's bounds, but for rounding, ``(B,)``."""
    doubt = NOTHING * (abs(form[0]) + abs(form[1]))
    return ~((interval[0] <= form[0] + doubt) & (interval[1] >= form[1] - doubt)).all(-1)
