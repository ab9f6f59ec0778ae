"""What a program does with the numbers of its step."""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from sagemp_cli.reachability.program.kinds import INPUTS, MATRICES
from sagemp_cli.reachability.program.program import Instruction, Program


class _Reads(NamedTuple):
    """Which entries of a slot depend on numbers of the step, and which on the state or the disturbance."""

    numbers: Tensor
    sets: Tensor


def numbers_are_added(program: Program) -> bool:
    """Whether numbers are only added to something, and scaled by constants, before anything nonlinear meets them.

    Then a propagator finds with numbers what it finds with constants in their places. A product with a number would be
    one of two values, where a product with a constant is linear.
    """
    reads: list[_Reads] = []
    for i in program.instructions:
        operands = [reads[slot] for slot in i.operands]
        if i.kind in INPUTS or i.kind == "constant":
            full = torch.ones(i.size, dtype=torch.bool)
            reads.append(_Reads(full & (i.kind == "numbers"), full & (i.kind in ("state", "disturbance"))))
        elif i.kind not in ("pick", "join", "linear", "add", "sub", "neg") and _meets_numbers(i.kind, operands):
            return False
        else:
            reads.append(_Reads(*(_through(i, [operand[which] for operand in operands]) for which in (0, 1))))
    return True


def _meets_numbers(kind: str, operands: Sequence[_Reads]) -> bool:
    """Whether a nonlinear operation has an operand that is nothing but numbers and constants."""
    alone = [o.numbers & ~o.sets for o in operands]
    if kind == "mul":
        constant = [~(o.numbers | o.sets) for o in operands]
        return any(bool((a & ~c).any()) for a, c in zip(alone, reversed(constant), strict=True))
    if kind == "div":
        constant = ~(operands[1].numbers | operands[1].sets)
        return bool(alone[1].any()) or bool((alone[0] & ~constant).any())
    return any(bool(a.any()) for a in alone)


def _through(i: Instruction, operands: Sequence[Tensor]) -> Tensor:
    if i.kind == "pick":
        return operands[0][torch.tensor(i.entries)]
    if i.kind == "join":
        return torch.cat(list(operands))
    if i.kind in MATRICES:
        return ((i.constants[0] != 0) & operands[0]).any(-1)
    return functools.reduce(operator.or_, operands).expand(i.size)
