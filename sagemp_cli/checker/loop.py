"""A program with everything done once that is the same at every step of a cell.

Slots that are linear in the step's inputs (a tracker's errors and its first layer, states that formulas take apart)
are one matrix over ``[1, x, w, numbers]`` each. What remains of them at a step is one column.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sagemp_cli.checker.balls import arb, arb_mat, balls
from sagemp_cli.checker.beside import Combinations
from sagemp_cli.checker.points import Point, value_of
from sagemp_cli.checker.program import INPUTS, MATRICES, Program
from sagemp_cli.checker.rows import ZERO, Rows, Weights, column, combined, joined, keeps_linear, weights_of

ONE = arb(1)


@dataclass(frozen=True)
class Folded:
    """A program and its exact constants.

    Attributes:
        program: it.
        constants: values of the slots that depend on no input.
        linear: of the slots that are linear in the inputs and that others need, rows over ``[1, x, w, numbers]``.
        known: whether a slot is one of these or stands behind them, so that no step computes it.
        weights: of the other ``linear`` instructions.
        last: the last slot that reads each slot.
        combinations: all slots, ready for intervals.
    """

    program: Program
    constants: Mapping[int, Point]
    linear: Mapping[int, Rows]
    known: tuple[bool, ...]
    weights: Mapping[int, Weights]
    last: tuple[int, ...]
    combinations: Combinations

    @classmethod
    def of(cls, program: Program) -> Folded:
        """From a program."""
        constants: dict[int, Point] = {}
        linear: dict[int, Rows] = {}
        weights: dict[int, Weights] = {}
        count = len(program.widths)
        outputs = [slot for slot in (program.next, program.control, program.deviation) if slot >= 0]
        needed, last = set(outputs), [count] * count
        for slot, instruction in enumerate(program.instructions):
            reads = instruction.reads
            for r in reads:
                last[r] = slot
            if not program.depends[slot]:
                constants[slot] = value_of(instruction, [constants[r] for r in reads])
            elif instruction.kind in INPUTS:
                linear[slot] = _input(program, instruction.kind)
            else:
                if instruction.kind in MATRICES:
                    weights[slot] = weights_of(instruction, program.widths[reads[0]])
                if keeps_linear(program, slot) and all(r in linear or r in constants for r in reads):
                    operands = [linear[r] if r in linear else column(constants[r]) for r in reads]
                    linear[slot] = combined(instruction, operands, weights.pop(slot, None))
                else:
                    needed.update(reads)
        for slot in outputs:
            last[slot] = count
        known = tuple(slot in constants or slot in linear for slot in range(count))
        kept = {s: r for s, r in linear.items() if s in needed}
        return cls(program, constants, kept, known, weights, tuple(last), Combinations(program, constants))


class Loop:
    """A program on the numbers of all steps, under a box of disturbances for each.

    Args:
        folded: the program.
        windows: numbers of each step, ``(K, g)``.
        lower, upper: the boxes, ``(K, d)``.
    """

    def __init__(self, folded: Folded, windows: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> None:
        self.folded = folded
        self._inputs = lower, upper, windows
        n, d, g = folded.program.states, folded.program.disturbances, folded.program.numbers
        ends = list(zip(balls(lower.T.flat), balls(upper.T.flat), strict=True))  # one disturbance after the other
        steps = len(windows)
        middle, radius = [(a + b) / 2 for a, b in ends], [(b - a) / 2 for a, b in ends]
        self._radius = [radius[k::steps] for k in range(steps)]
        known = arb_mat(1 + d + g, steps, [*[ONE] * steps, *middle, *balls(windows.T.flat)])
        self._columns, self._on_state, self._rest = {}, {}, {}
        for slot, rows in folded.linear.items():
            wide = [row + [ZERO] * (1 + n + d + g - len(row)) for row in rows]
            self._columns[slot] = joined([[row[0], *row[1 + n :]] for row in wide]) * known
            self._on_state[slot] = arb_mat(len(wide), n, [a for row in wide for a in row[1 : 1 + n]])
            self._rest[slot] = [(row[1 : 1 + n], _trimmed(row[1 + n : 1 + n + d])) for row in wide]

    def given(self, k: int) -> list[tuple[arb, arb]]:
        """Both ends of the disturbances and of the numbers of step k, one after the other."""
        lower, upper, windows = (balls(rows[k]) for rows in self._inputs)
        return [*zip(lower, upper, strict=True), *zip(windows, windows, strict=True)]

    def rows(self, slot: int, k: int, center: arb_mat) -> Rows:
        """Rows of a linear slot at step k, where the states are around the ``center (n, 1)``."""
        columns, at, radius = self._columns[slot], self._on_state[slot] * center, self._radius[k]
        return [
            [columns[i, k] + at[i, 0], *_trimmed(on_state + [b * r for b, r in zip(on_w, radius, strict=False)])]
            for i, (on_state, on_w) in enumerate(self._rest[slot])
        ]


def _trimmed(row: list) -> list:
    """Without the zeros at its end."""
    while row and row[-1] == 0:
        row.pop()
    return row


def _input(program: Program, kind: str) -> Rows:
    """An input of the step over ``[1, x, w, numbers]``."""
    n, d, g = program.states, program.disturbances, program.numbers
    first, count = {"state": (1, n), "disturbance": (1 + n, d), "numbers": (1 + n + d, g)}[kind]
    return [[ZERO] * (first + i) + [ONE] for i in range(count)]
