"""The intervals of a step's values, beside the rows that :mod:`~sagemp_cli.checker.step` has of them.

Rows know how values hang together and reach past what a function can give; an interval is the other way round. Both
hold, so an operation is bounded over what lies in both. Between nonlinear instructions every slot is a fixed
combination of *basic* values, 1, states, disturbances, numbers and results of nonlinear instructions before it, and
its interval is that of the combination, in which what cancels has cancelled.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sagemp_cli.checker.balls import arb, arb_mat
from sagemp_cli.checker.points import Point
from sagemp_cli.checker.program import INPUTS, Instruction, Program
from sagemp_cli.checker.ranges import Range, values
from sagemp_cli.checker.rows import (
    ZERO,
    Row,
    Rows,
    column,
    combined,
    keeps_linear,
    repeated,
    subtracted,
    transformed,
    weights_of,
)

ONE = arb(1)


class Combinations:
    """A program, ready for intervals.

    Args:
        program: it.
        constants: of the slots that depend on no input.

    Attributes:
        columns: basic values.
        first: of each nonlinear slot, the first of its own.
        operands: of each nonlinear slot, its operands, equally long; of two that are compared, or that are chosen from,
            also their difference; of sums in float32 the exact sums and what is summed.
        outputs: of the slots that are outputs.
    """

    def __init__(self, program: Program, constants: Mapping[int, Point]) -> None:
        rows: dict[int, Rows] = {}
        self.columns = 1 + program.states + program.disturbances + program.numbers
        self.first: dict[int, int] = {}
        self.operands: dict[int, list[_Combination]] = {}
        for slot, instruction in enumerate(program.instructions):
            if slot in constants:
                rows[slot] = column(constants[slot])
            elif instruction.kind in INPUTS:
                rows[slot] = _units(_begin(program, instruction.kind), program.widths[slot])
            elif keeps_linear(program, slot):
                rows[slot] = self._linear(program, instruction, [rows[r] for r in instruction.reads])
            else:
                read = [rows[r] for r in instruction.reads]
                if instruction.kind == "float32_linear":  # the exact sums, and what is summed
                    read = [transformed(weights_of(instruction, len(read[0])), read[0]), *read]
                else:
                    read = repeated(read)
                if instruction.kind in ("maximum", "minimum", "logaddexp", "where"):
                    read.append([subtracted(a, b) for a, b in zip(*read[-2:], strict=True)])
                self.operands[slot] = [_Combination(part) for part in read]
                self.first[slot] = self.columns
                rows[slot] = _units(self.columns, program.widths[slot])
                self.columns += program.widths[slot]
        outputs = {slot for slot in (program.next, program.control, program.deviation) if slot >= 0}
        self.outputs = {slot: _Combination(rows[slot]) for slot in outputs}

    def _linear(self, program: Program, instruction: Instruction, read: Sequence[Rows]) -> Rows:
        weights = None
        if instruction.kind == "linear":
            weights = weights_of(instruction, program.widths[instruction.reads[0]])
            if instruction.reads[0] in self.first:  # of basic values: the matrix itself
                matrix, bias = weights
                before = [ZERO] * (self.first[instruction.reads[0]] - 1)
                wide, flat = matrix.ncols(), matrix.entries()
                return [[b, *before, *flat[i * wide : (i + 1) * wide]] for i, b in enumerate(bias)]
        return combined(instruction, read, weights)


class Beside:
    """The intervals of one step.

    Args:
        program: ready.
        inputs: of states, disturbances and numbers, one after the other.
    """

    def __init__(self, program: Combinations, inputs: Sequence[Range]) -> None:
        self._of = program
        self._ends: list[Range] = [(ONE, ONE), *inputs, *[None] * (program.columns - 1 - len(inputs))]

    def operands(self, slot: int) -> list[list[Range]]:
        """Of the operands of a nonlinear slot, as :class:`Combinations` has them."""
        return [combination.of(self._ends) for combination in self._of.operands[slot]]

    def know(self, slot: int, instruction: Instruction, operands: Sequence[Sequence[Range]]) -> None:
        """The result of a nonlinear slot, from intervals of its operands."""
        read = len(operands) if instruction.kind == "float32_linear" else len(instruction.reads)
        found = values(instruction, operands[:read])
        first = self._of.first[slot]
        self._ends[first : first + len(found)] = found

    def output(self, slot: int) -> list[Range]:
        """Of a slot that is an output."""
        return self._of.outputs[slot].of(self._ends)


class _Combination:
    """Rows over basic values, applied to intervals: the positive coefficients to the one end, the others to the other.

    Upper ends, and lower ones with their sign changed, are one product with a matrix that is not negative.
    """

    def __init__(self, rows: Rows) -> None:
        width = max(map(len, rows))
        self._used = [j for j in range(1, width) if not all(_is_zero(_at(row, j)) for row in rows)]
        self._constant = [row[0] for row in rows]
        up = [[_at(row, j).max(ZERO) for j in self._used] for row in rows]
        down = [[(-_at(row, j)).max(ZERO) for j in self._used] for row in rows]
        self._reads = [[j for j in self._used if not _is_zero(_at(row, j))] for row in rows]
        flat = [a for u, d in zip(up, down, strict=True) for a in (*u, *d)]
        flat += [a for u, d in zip(up, down, strict=True) for a in (*d, *u)]
        self._matrix = arb_mat(2 * len(rows), 2 * len(self._used), flat)

    def of(self, ends: Sequence[Range]) -> list[Range]:
        """Their intervals, from those of the basic values."""
        known = [ends[j] for j in self._used]
        highs = [ZERO if r is None else r[1] for r in known]
        lows = [ZERO if r is None else -r[0] for r in known]
        count = len(self._constant)
        if self._used:
            flat = (self._matrix * arb_mat(2 * len(known), 1, highs + lows)).entries()
        else:
            flat = [ZERO] * (2 * count)
        out: list[Range] = []
        for i, c in enumerate(self._constant):
            if any(ends[j] is None for j in self._reads[i]):
                out.append(None)
            else:
                out.append(((c - flat[count + i]).lower(), (c + flat[i]).upper()))
        return out


def _is_zero(a: arb) -> bool:
    """Whether a number is 0 for certain: of a ball around 0 neither ``a == 0`` holds nor ``a != 0``."""
    return bool(a == 0)


def _at(row: Row, j: int) -> arb:
    return row[j] if j < len(row) else ZERO


def _units(first: int, count: int) -> Rows:
    """Basic values as rows."""
    return [[ZERO] * (first + i) + [ONE] for i in range(count)]


def _begin(program: Program, kind: str) -> int:
    n, d = program.states, program.disturbances
    return {"state": 1, "disturbance": 1 + n, "numbers": 1 + n + d}[kind]
