"""A program at a point, in balls: what is constant in it, and rollouts that are replayed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from sagemp_cli.checker.balls import arb, balls
from sagemp_cli.checker.float32 import Rounding, of_sums
from sagemp_cli.checker.functions import Function, clamp, function_of, log_of_sum
from sagemp_cli.checker.jumps import Sawtooth, Staircase
from sagemp_cli.checker.program import INPUTS, MATRICES, Instruction, Program

Point = list[arb]


def outputs_at(program: Program, inputs: Mapping[str, Point]) -> dict[str, Point]:
    """The outputs of a program that has them, by name.

    Args:
        program: the step.
        inputs: ``state``, ``disturbance`` and ``numbers``.
    """
    values: list[Point] = []
    for instruction in program.instructions:
        if instruction.kind in INPUTS:
            values.append(list(inputs[instruction.kind]))
        else:
            values.append(value_of(instruction, [values[r] for r in instruction.reads]))
    slots = {"next": program.next, "control": program.control, "deviation": program.deviation}
    return {name: values[slot] for name, slot in slots.items() if slot >= 0}


def value_of(instruction: Instruction, operands: Sequence[Point]) -> Point:
    """The result of an instruction that is no input of the step."""
    kind, constants = instruction.kind, instruction.constants
    if kind == "constant":
        return balls(constants)
    if kind == "pick":
        return [operands[0][i] for i in instruction.entries]
    if kind == "join":
        return [entry for operand in operands for entry in operand]
    if kind in MATRICES:
        exact = _linear(constants, operands[0])
        return exact if kind == "linear" else _in_float32(constants, operands[0], exact)
    if kind in _PAIRS:
        width = max(map(len, operands))
        pairs = zip(*(list(o) * (width if len(o) == 1 else 1) for o in operands), strict=True)
        return [_PAIRS[kind](a, b) for a, b in pairs]
    if kind == "where":
        width = max(map(len, operands))
        entries = zip(*(list(o) * (width if len(o) == 1 else 1) for o in operands), strict=True)
        return [a if c > 0 else b if c <= 0 else a.union(b) for c, a, b in entries]
    if kind == "neg":
        return [-a for a in operands[0]]
    return [f.value(a) for f, a in zip(functions_of(instruction, len(operands[0])), operands[0], strict=True)]


def functions_of(instruction: Instruction, width: int) -> list[Function | Staircase | Sawtooth | Rounding]:
    """The function of each entry of an instruction that has one operand and is not linear."""
    constants = instruction.constants.tolist()
    if instruction.kind == "clamp":
        return [clamp(low, high) for low, high in zip(constants[:width], constants[width:], strict=True)]
    return [function_of(instruction.kind, constants)] * width


def _linear(constants: np.ndarray, operand: Point) -> Point:
    columns = len(operand)
    rows = len(constants) // (columns + 1)
    weights, bias = balls(constants[: rows * columns]), balls(constants[rows * columns :])
    return [
        sum((w * a for w, a in zip(weights[i * columns : (i + 1) * columns], operand, strict=True)), start=bias[i])
        for i in range(rows)
    ]


def _in_float32(constants: np.ndarray, operand: Point, exact: Point) -> Point:
    """All that float32 arithmetic may give for these sums."""
    most = _linear(abs(constants), [abs(a).upper() for a in operand])
    return [a + arb(0, of_sums(size.upper(), len(operand))) for a, size in zip(exact, most, strict=True)]


_PAIRS: Mapping[str, Callable[[arb, arb], arb]] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "maximum": arb.max,
    "minimum": arb.min,
    "atan2": lambda y, x: arb.atan2(y, x),
    "logaddexp": log_of_sum,
}
