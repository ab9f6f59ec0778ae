"""Writes a program down while an example is computed.

Every scalar that the example computes has a number (its id). A tensor of ids says where each of its entries comes
from, so that whatever only moves entries is done by torch itself, on ids.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sagemp_cli.errors import SagempError, UsageError
from sagemp_cli.reachability.program.kinds import INPUTS
from sagemp_cli.reachability.program.program import Instruction, Program, program_of


@dataclass(frozen=True)
class Slot:
    """The value of an earlier instruction."""

    index: int


class Recorder:
    """The program so far.

    Args:
        state, disturbance, numbers: the example's, ``(n,)``, ``(d,)``, ``(g,)``.

    Attributes:
        state, disturbance, numbers: ids of these.
        zero: the id of the constant 0, which is 0: operations that fill with zeros fill with it.
        unwritten: the id of an entry that has no value yet.
        refusal: the first error that said that the step cannot be bounded, should the step have caught it.
    """

    zero = 0
    unwritten = -1

    def __init__(self, state: Tensor, disturbance: Tensor, numbers: Tensor) -> None:
        self.refusal: SagempError | None = None
        self._instructions: list[Instruction] = []
        self._starts: list[int] = []
        self._size = 0
        self._table = torch.zeros(0, dtype=torch.float64)  # of each id: the example's number
        self._owner = torch.zeros(0, dtype=torch.int64)  # the instruction that made it
        self._fixed = torch.zeros(0, dtype=torch.bool)  # and whether that is a constant
        self._slots: dict[Any, int] = {}
        self._examples: list[Tensor] = []
        self.constant(torch.zeros(1, dtype=torch.float64))
        self.state, self.disturbance, self.numbers = (
            self._new(Instruction(kind, len(value)), value)
            for kind, value in zip(INPUTS, (state, disturbance, numbers), strict=True)
        )

    # -- ids -----------------------------------------------------------------------------------------------------------

    def constant(self, value: Tensor) -> Tensor:
        """Ids of constants, in the shape of ``value`` (float64)."""
        flat = value.reshape(-1)
        return self._new(Instruction("constant", len(flat), constants=(flat.clone(),))).reshape(value.shape)

    def is_constant(self, ids: Tensor) -> bool:
        """Whether no entry depends on the inputs."""
        return bool(self.constant_entries(ids).all())

    def constant_entries(self, ids: Tensor) -> Tensor:
        """Which entries do not depend on the inputs."""
        self._check_written(ids)
        return self._fixed[ids]

    def example(self, ids: Tensor) -> Tensor:
        """The numbers of the example, in the shape and strides of the ids; NaN where nothing was written."""
        return self._table[ids]  # -1 is the last entry

    # -- writing -------------------------------------------------------------------------------------------------------

    def operand(self, ids: Tensor, *, full: bool = False) -> Slot | Tensor:
        """What an instruction reads for these ids: a slot, or a tensor if all are constants.

        The vector has one entry per id, or a single one if all are equal and ``full`` is not asked for.
        """
        flat = ids.reshape(-1).contiguous()
        alone = len(flat) > 0 and bool((flat == flat[0]).all()) and not full
        if self.is_constant(flat):
            return self._constants(flat[:1] if alone else flat)
        if alone:
            return Slot(self._gathered([(int(self._owner[flat[0]]), flat[:1])]))
        runs = self._runs(flat)
        if len(runs) <= 2 * len({owner for owner, _ in runs}):
            return Slot(self._gathered(runs))
        unique, inverse = torch.unique(flat, return_inverse=True)  # many short runs: in order first, then picked
        slot = self._gathered(self._runs(unique))
        return Slot(slot if torch.equal(inverse, torch.arange(len(unique))) else self._write_once(_pick(slot, inverse)))

    def write(self, kind: str, operands: Sequence[Slot | Tensor], constants: Sequence[Tensor] = ()) -> Tensor:
        """Append an instruction on slots and vectors of constants; ids ``(m,)`` of its result.

        Without a slot among the operands the result is constant: what torch makes of them.
        """
        sizes = [self.size_of(o) if isinstance(o, Slot) else len(o) for o in operands]
        size = len(constants[0]) if kind == "linear" else max(sizes)
        if not any(isinstance(o, Slot) for o in operands):
            return self.constant(Instruction(kind, size, constants=tuple(constants)).on(*operands))
        slots = tuple(o.index if isinstance(o, Slot) else self._constant_slot(o) for o in operands)
        return self._new(Instruction(kind, size, slots, tuple(constants)))

    def angle_of(self, sines: Tensor, cosines: Tensor) -> Tensor | None:
        """Ids of the values whose sines and cosines have these ids, of the same shape; None if they are no such."""
        found: list[int] = []
        for pair in zip(sines.reshape(-1).tolist(), cosines.reshape(-1).tolist(), strict=True):
            of = []
            for kind, id_ in zip(("sin", "cos"), pair, strict=True):
                owner = int(self._owner[id_])
                if id_ < 0 or self._instructions[owner].kind != kind:
                    return None
                of.append(self._starts[self._instructions[owner].operands[0]] + id_ - self._starts[owner])
            if of[0] != of[1]:
                return None
            found.append(of[0])
        return torch.tensor(found, dtype=torch.int64).reshape(sines.shape) if found else None

    def size_of(self, slot: Slot) -> int:
        """Entries of an instruction's result."""
        return self._instructions[slot.index].size

    def finish(self, **outputs: Tensor | None) -> Program:
        """The program whose outputs have these ids; what they do not need is dropped."""
        slots: dict[str, int | None] = {}
        for name, ids in outputs.items():
            operand = None if ids is None else self.operand(ids, full=True)
            slots[name] = self._constant_slot(operand) if isinstance(operand, Tensor) else operand and operand.index
        inputs = {int(self._owner[ids[0]]) for ids in (self.state, self.disturbance, self.numbers) if len(ids)}
        return program_of(self._instructions, inputs, slots)

    # -- bookkeeping ---------------------------------------------------------------------------------------------------

    def _new(self, instruction: Instruction, example: Tensor | None = None) -> Tensor:
        of_it = (self._examples[o] for o in instruction.operands)
        found: Tensor = (instruction.on(*of_it) if example is None else example).detach()
        start, self._size = self._size, self._size + instruction.size
        self._instructions.append(instruction)
        self._starts.append(start)
        self._examples.append(found)
        if self._size >= len(self._table):  # there is always a last entry, which is no number
            more = max(self._size + 1 - len(self._table), 1024)
            self._table = torch.cat([self._table, self._table.new_full((more,), torch.nan)])
            self._owner = torch.cat([self._owner, self._owner.new_zeros(more)])
            self._fixed = torch.cat([self._fixed, self._fixed.new_zeros(more)])
        self._table[start : self._size] = found
        self._owner[start : self._size] = len(self._instructions) - 1
        self._fixed[start : self._size] = instruction.kind == "constant"
        return torch.arange(start, self._size)

    def _check_written(self, ids: Tensor) -> None:
        if ids.numel() and int(ids.min()) < 0:
            raise UsageError(
                "step reads an entry that was never written (torch.empty_like leaves entries without a value)"
            )

    def _runs(self, ids: Tensor) -> list[tuple[int, Tensor]]:
        """Neighbours that one instruction made, with its number."""
        kinds, counts = torch.unique_consecutive(self._owner[ids], return_counts=True)
        return list(zip(kinds.tolist(), ids.split(counts.tolist()), strict=True))

    def _constants(self, ids: Tensor) -> Tensor:
        """The constants with these ids; with their gradient, where they have one."""
        if not torch.is_grad_enabled():
            return self._table[ids]
        return torch.cat(
            [self._instructions[owner].constants[0][i - self._starts[owner]] for owner, i in self._runs(ids)]
        )

    def _gathered(self, runs: Sequence[tuple[int, Tensor]]) -> int:
        """A slot whose entries are these ids, one run after the other."""
        parts: list[int] = []
        for owner, ids in runs:
            entries, instruction = ids - self._starts[owner], self._instructions[owner]
            if instruction.kind == "constant":
                parts.append(self._constant_slot(instruction.constants[0][entries]))
            elif torch.equal(entries, torch.arange(instruction.size)):
                parts.append(owner)
            else:
                parts.append(self._write_once(_pick(owner, entries)))
        if len(parts) == 1:
            return parts[0]
        return self._write_once(Instruction("join", sum(len(ids) for _, ids in runs), tuple(parts)))

    def _constant_slot(self, value: Tensor) -> int:
        return self._write_once(Instruction("constant", len(value), constants=(value,)))

    def _write_once(self, instruction: Instruction) -> int:
        value = instruction.constants[0] if instruction.constants else None
        if value is not None and value.requires_grad:  # equal numbers may be different weights
            self._new(instruction)
            return len(self._instructions) - 1
        numbers = None if value is None else value.numpy().tobytes()
        key = (instruction.kind, instruction.operands, instruction.entries, numbers)
        if key not in self._slots:
            self._new(instruction)
            self._slots[key] = len(self._instructions) - 1
        return self._slots[key]


def _pick(slot: int, entries: Tensor) -> Instruction:
    return Instruction("pick", len(entries), (slot,), entries=tuple(entries.tolist()))
