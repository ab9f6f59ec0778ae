"""Rows of balls: what is linear acts on them. A row is a list that ends where only zeros would follow."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import repeat

from sagemp_cli.checker.balls import arb, arb_mat, balls
from sagemp_cli.checker.points import Point
from sagemp_cli.checker.program import MOVES, Instruction, Program

Row = list[arb]
Rows = list[Row]
Weights = tuple[arb_mat, Point]
"""Matrix and bias of a ``linear``."""

ZERO = arb(0)


def keeps_linear(program: Program, slot: int) -> bool:
    """Whether a slot is linear in its operands, of which those that depend on nothing count as numbers."""
    instruction = program.instructions[slot]
    given = [program.depends[r] for r in instruction.reads]
    kind = instruction.kind
    return kind in MOVES or (kind == "mul" and not all(given)) or (kind == "div" and not given[1])


def combined(instruction: Instruction, operands: Sequence[Rows], weights: Weights | None) -> Rows:
    """Rows of a result that is linear in its operands, of which numbers are rows of one entry."""
    kind = instruction.kind
    if kind == "pick":
        return [operands[0][i] for i in instruction.entries.tolist()]
    if kind == "join":
        return [row for operand in operands for row in operand]
    if kind == "linear":
        assert weights is not None
        return transformed(weights, operands[0])
    if kind == "neg":
        return [[-a for a in row] for row in operands[0]]
    left, right = repeated(operands)
    if kind == "add":
        return [added(a, b) for a, b in zip(left, right, strict=True)]
    if kind == "sub":
        return [subtracted(a, b) for a, b in zip(left, right, strict=True)]
    if kind == "div":
        return [times(a, 1 / b[0]) for a, b in zip(left, right, strict=True)]
    return [times(a, b[0]) if len(b) == 1 else times(b, a[0]) for a, b in zip(left, right, strict=True)]


def repeated(operands: Sequence[Rows]) -> list[Rows]:
    """Operands as long as the longest; a single row stands for all."""
    count = max(map(len, operands))
    return [rows if len(rows) == count else rows * count for rows in operands]


def added(a: Row, b: Row) -> Row:
    """The sum of two rows."""
    common = min(len(a), len(b))
    return [x + y for x, y in zip(a, b, strict=False)] + a[common:] + b[common:]


def subtracted(a: Row, b: Row) -> Row:
    """The difference of two rows."""
    common = min(len(a), len(b))
    return [x - y for x, y in zip(a, b, strict=False)] + a[common:] + [-y for y in b[common:]]


def times(row: Row, factor: arb) -> Row:
    """A multiple of a row."""
    return [a * factor for a in row]


def transformed(weights: Weights, rows: Rows) -> Rows:
    """Matrix and bias applied to rows."""
    matrix, bias = weights
    product = matrix * joined(rows)
    flat, width = product.entries(), product.ncols()
    out = [flat[i : i + width] for i in range(0, len(flat), width)]
    for row, b in zip(out, bias, strict=True):
        row[0] = row[0] + b
    return out


def joined(rows: Rows, width: int = 1) -> arb_mat:
    """Rows as a matrix, at least that wide."""
    width = max(width, *map(len, rows))
    flat: list[arb] = []
    for row in rows:
        flat += row
        flat += repeat(ZERO, width - len(row))
    return arb_mat(len(rows), width, flat)


def column(values: Point) -> Rows:
    """Numbers as rows."""
    return [[v] for v in values]


def weights_of(instruction: Instruction, columns: int) -> Weights:
    """Matrix and bias of a ``linear`` on an operand of so many entries, exact."""
    values = balls(instruction.constants)
    count = len(values) // (columns + 1)
    return arb_mat(count, columns, values[: count * columns]), values[count * columns :]
