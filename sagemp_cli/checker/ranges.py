"""What an output of a program never leaves, whatever the state: a control that saturates."""

from __future__ import annotations

from collections.abc import Sequence

from sagemp_cli.checker.balls import arb, ball, balls
from sagemp_cli.checker.loop import Folded
from sagemp_cli.checker.program import Instruction

Range = tuple[arb, arb] | None
"""Ends of an interval; None where nothing is known."""


def range_of(folded: Folded, slot: int) -> list[Range]:
    """Bounds of each entry of a slot."""
    program = folded.program
    ranges: list[list[Range]] = []
    for i, instruction in enumerate(program.instructions[: slot + 1]):
        if i in folded.constants:
            ranges.append([(v, v) for v in folded.constants[i]])
        else:
            ranges.append(_range(instruction, [ranges[r] for r in instruction.reads], program.widths[i]))
    return ranges[slot]


def _range(instruction: Instruction, operands: Sequence[list[Range]], width: int) -> list[Range]:
    kind = instruction.kind
    if kind in _BOUNDED:
        return [(ball(_BOUNDED[kind][0]), ball(_BOUNDED[kind][1]))] * width
    if kind == "clamp":
        lower, upper = instruction.constants.reshape(2, width)
        known = (abs(lower) < float("inf")) & (abs(upper) < float("inf"))
        return [(ball(a), ball(b)) if k else None for a, b, k in zip(lower, upper, known, strict=True)]
    if kind == "pick":
        return [operands[0][i] for i in instruction.entries]
    if kind == "join":
        return [entry for operand in operands for entry in operand]
    if kind == "neg":
        return [_times(r, ball(-1)) for r in operands[0]]
    if kind in ("add", "sub", "mul"):
        a, b = ([*o] * (width if len(o) == 1 else 1) for o in operands)
        if kind == "mul":
            return [_product(x, y) for x, y in zip(a, b, strict=True)]
        sign = ball(1 if kind == "add" else -1)
        return [_sum(x, _times(y, sign)) for x, y in zip(a, b, strict=True)]
    if kind == "linear":
        return _linear(instruction, operands[0], width)
    return [None] * width


def _linear(instruction: Instruction, operand: list[Range], width: int) -> list[Range]:
    columns = len(operand)
    weights = instruction.constants[: width * columns].reshape(width, columns)
    out: list[Range] = [(b, b) for b in balls(instruction.constants[width * columns :])]
    for i, row in enumerate(weights.tolist()):
        for w, r in zip(row, operand, strict=True):
            if w:
                out[i] = _sum(out[i], _times(r, ball(w)))
    return out


def _product(a: Range, b: Range) -> Range:
    """Ends of a product of which one factor is a number; nothing is said of others."""
    for number, other in ((a, b), (b, a)):
        if number is not None and number[0].is_exact() and number[0] == number[1]:
            return number if number[0] == 0 else _times(other, number[0])
    return None


def _times(a: Range, factor: arb) -> Range:
    if a is None:
        return None
    ends = a[0] * factor, a[1] * factor
    return ends if factor > 0 else (ends[1], ends[0])


def _sum(a: Range, b: Range) -> Range:
    return None if a is None or b is None else (a[0] + b[0], a[1] + b[1])


_BOUNDED = {"sin": (-1.0, 1.0), "cos": (-1.0, 1.0), "tanh": (-1.0, 1.0), "sigmoid": (0.0, 1.0)}
