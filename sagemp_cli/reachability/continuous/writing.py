"""Writing a program from another one: instructions without repetitions, exact throughout."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from sagemp_cli.reachability.program.kinds import INPUTS
from sagemp_cli.reachability.program.program import Instruction, Outputs, Program, program_of


class Writer:
    """Instructions so far; a value is the number of its slot.

    An instruction that is there already is not written again. Nothing is computed here: what reads constants only is
    made to read the state as well, with weight 0, so that all that is written means what it says in real arithmetic.

    Args:
        states, disturbances, numbers: entries of the inputs; no numbers if 0.
    """

    def __init__(self, states: int, disturbances: int, numbers: int = 0) -> None:
        self._instructions = [Instruction("state", states), Instruction("disturbance", disturbances)]
        if numbers:
            self._instructions.append(Instruction("numbers", numbers))
        self._known: dict[tuple, int] = {}
        self.state, self.disturbance, self.numbers = 0, 1, 2 if numbers else None

    def size(self, slot: int) -> int:
        """Entries of a value."""
        return self._instructions[slot].size

    def is_constant(self, slot: int) -> bool:
        """Whether a value depends on no input."""
        return self._instructions[slot].kind == "constant"

    def constant(self, values: Tensor | Sequence[float]) -> int:
        """Fixed numbers."""
        vector = torch.as_tensor(values, dtype=torch.float64)
        return self._write(Instruction("constant", len(vector), constants=(vector,)))

    def made(self, i: Instruction, operands: Sequence[int]) -> int:
        """What an instruction of another program makes of values."""
        return self.of(i.kind, *operands, constants=i.constants, entries=i.entries, size=i.size)

    def of(
        self,
        kind: str,
        *operands: int,
        constants: tuple[Tensor, ...] = (),
        entries: tuple[int, ...] = (),
        size: int | None = None,
    ) -> int:
        """A value; its size is that of its largest operand unless said otherwise."""
        if all(map(self.is_constant, operands)):
            operands = (self._varying(operands[0]), *operands[1:])
        entries_of = max(map(self.size, operands)) if size is None else size
        return self._write(Instruction(kind, entries_of, tuple(operands), constants, entries))

    def pick(self, slot: int, first: int, count: int) -> int:
        """Neighbouring entries of a value."""
        if count == self.size(slot):
            return slot
        return self.of("pick", slot, entries=tuple(range(first, first + count)), size=count)

    def join(self, *parts: int) -> int:
        """Values one after the other."""
        return parts[0] if len(parts) == 1 else self.of("join", *parts, size=sum(map(self.size, parts)))

    def scaled(self, slot: int, factor: float) -> int:
        """A multiple."""
        return slot if factor == 1 else self.of("mul", slot, self.constant([factor]))

    def divided(self, slot: int, divisor: float) -> int:
        """A fraction."""
        return slot if divisor == 1 else self.of("div", slot, self.constant([divisor]))

    def embedded(self, program: Program, inputs: Mapping[str, int]) -> Outputs:
        """Another program's outputs, with its inputs replaced by values."""
        values: list[int] = []
        for i in program.instructions:
            if i.kind in INPUTS:
                values.append(inputs.get(i.kind, self.disturbance))
            elif i.kind == "constant":
                values.append(self.constant(i.constants[0]))
            else:
                values.append(self.made(i, [values[o] for o in i.operands]))
        return program.outputs.of(values)

    def finished(self, **outputs: int | None) -> Program:
        """The program, without what no output needs."""
        inputs = [s for s in (self.state, self.disturbance, self.numbers) if s is not None]
        return program_of(self._instructions, inputs, outputs)

    def _varying(self, slot: int) -> int:
        """A constant as a function of the state that does not look at it."""
        (vector,) = self._instructions[slot].constants
        matrix = torch.zeros(len(vector), self.size(self.state), dtype=torch.float64)
        return self._write(Instruction("linear", len(vector), (self.state,), (matrix, vector)))

    def _write(self, i: Instruction) -> int:
        key = (i.kind, i.size, i.operands, i.entries, tuple(c.detach().numpy().tobytes() for c in i.constants))
        if key not in self._known or any(c.requires_grad for c in i.constants):
            self._instructions.append(i)
            self._known[key] = len(self._instructions) - 1
        return self._known[key]
