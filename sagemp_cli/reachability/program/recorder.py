"""Writes a program down while an example is computed.

Every scalar that the example computes has a number (its id). A tensor of ids says where each of its entries comes
from, so that whatever only moves entries is done by torch itself, on ids.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sagemp_cli.errors import SagempError, UsageError
from sagemp_cli.reachability.program.float32 import error_kind
from sagemp_cli.reachability.program.kinds import INPUTS, MATRICES
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
        float32: whether what is written now is computed in float32.
        refusal: the first error that said that the step cannot be bounded, should the step have caught it.
    """

    zero = 0
    unwritten = -1

    def __init__(self, state: Tensor, disturbance: Tensor, numbers: Tensor) -> None:
        self.refusal: SagempError | None = None
        self.float32 = False
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
        size = len(constants[0]) if kind in MATRICES else max(sizes)
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

    def condition_of(self, truth: Tensor) -> tuple[Tensor, bool] | None:
        """Ids of what is positive where truth values with these ids are 1, or (True) where they are 0; None if they are
        no comparisons, or of both kinds.
        """
        found: list[int] = []
        kinds: set[bool] = set()
        for id_ in truth.reshape(-1).tolist():
            owner = self._instructions[int(self._owner[id_])]
            place = id_ - self._starts[int(self._owner[id_])]
            negated = owner.kind == "sub"
            if negated:  # 1 less a truth value
                one, inner = (self._instructions[o] for o in owner.operands)
                if one.kind != "constant" or not bool((one.constants[0] == 1).all()) or inner.kind != "positive":
                    return None
                owner = inner
            if owner.kind != "positive":
                return None
            kinds.add(negated)
            found.append(self._starts[owner.operands[0]] + min(place, owner.size - 1))
        if len(kinds) != 1:
            return None
        return torch.tensor(found, dtype=torch.int64).reshape(truth.shape), kinds.pop()

    def instruction_of(self, id_: int) -> tuple[Instruction, int]:
        """What made a value, and which entry of the result it is."""
        owner = int(self._owner[id_])
        return self._instructions[owner], id_ - self._starts[owner]

    def ids_of_slot(self, slot: int) -> Tensor:
        """Of all entries of an instruction's result."""
        return torch.arange(self._starts[slot], self._starts[slot] + self._instructions[slot].size)

    def replaced(
        self, ids: Tensor, old: Tensor, new: Tensor, *, own: Tensor, of: Tensor
    ) -> tuple[Tensor, tuple[str, ...]] | None:
        """Values with these ids, computed again with other values in the places of some; and the kinds of instructions
        that this takes, none if they do not depend on them. None if one depends on what is replaced for others.

        Args:
            ids: of what is computed again.
            old, new: ids, one for one; what is the same instruction on the same values is replaced too.
            own, of: for which of the ids something is replaced: numbers for ``ids`` and for ``old``, alike where it is.
        """
        numbers: dict[Any, int] = {}
        number = [numbers.setdefault(key, len(numbers)) for key in self._keys(numbers)]
        known = dict(zip(old.reshape(-1).tolist(), new.reshape(-1).tolist(), strict=True))
        name = {o: (number[int(self._owner[o])], o - self._starts[int(self._owner[o])]) for o in known}
        alike = {name[o]: n for o, n in known.items()}
        bits = {mark: 1 << i for i, mark in enumerate(of.unique().tolist())}
        marks = dict(zip(old.reshape(-1).tolist(), of.reshape(-1).tolist(), strict=True))
        marked = {
            (number[int(self._owner[o])], o - self._starts[int(self._owner[o])]): bits[m] for o, m in marks.items()
        }
        rests: dict[int, list[int]] = {}  # of every entry of a slot, on what it depends that is replaced, as bits
        made: dict[int, Tensor] = {}
        kinds: list[str] = []

        def translated(of: Tensor) -> Tensor:
            """After all that they depend on."""
            out = []
            for id_ in of.reshape(-1).tolist():
                owner = int(self._owner[id_])
                again, place = made.get(owner), id_ - self._starts[owner]
                out.append(alike.get((number[owner], place), id_ if again is None else int(again[place])))
            return torch.tensor(out, dtype=torch.int64).reshape(of.shape)

        order, pending = set(), set(self._owner[ids.reshape(-1)].tolist())
        while pending:
            slot = pending.pop()
            if slot not in order:
                order.add(slot)
                pending.update(self._instructions[slot].operands)
        for slot in sorted(order):
            i = self._instructions[slot]
            rest = _depending(i, [rests[o] for o in i.operands])
            rests[slot] = [marked.get((number[slot], place), r) for place, r in enumerate(rest)]
            before = [self.ids_of_slot(o) for o in i.operands]
            after = [translated(b) for b in before]
            if all(torch.equal(a, b) for a, b in zip(after, before, strict=True)):
                continue
            if i.kind == "pick":
                made[slot] = after[0][list(i.entries)]
            elif i.kind == "join":
                made[slot] = torch.cat(after)
            else:
                kinds.append(i.kind)
                read = [self.operand(a, full=len(a) > 1) for a in after]
                made[slot] = self.write(i.kind, read, i.constants)
        for id_, mark in zip(ids.reshape(-1).tolist(), own.reshape(-1).tolist(), strict=True):
            owner = int(self._owner[id_])
            if rests[owner][id_ - self._starts[owner]] & ~bits.get(mark, 0):
                return None
        return translated(ids), tuple(kinds)

    def rounded(self, kind: str, ids: Tensor) -> Tensor:
        """Ids of what arithmetic makes of the result of an instruction: the same, unless it is float32."""
        error = error_kind(kind) if self.float32 else None
        return ids if error is None else self.write(error, [self.operand(ids, full=True)])

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

    def _keys(self, numbers: dict[Any, int]) -> Iterator[Any]:
        """Of every instruction what is equal for the same on the same values, as these are numbered so far."""
        of: list[int] = []
        for i in self._instructions:
            own = tuple(c.detach().numpy().tobytes() for c in i.constants)
            first = len(of) if i.kind in INPUTS else None
            key = (i.kind, tuple(of[o] for o in i.operands), own, i.entries, i.size, first)
            of.append(numbers.get(key, len(numbers)))
            yield key

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


def _depending(instruction: Instruction, operands: Sequence[list[int]]) -> list[int]:
    """For every entry of a result the bits of the entries that it is made of."""
    if instruction.kind == "pick":
        return [operands[0][e] for e in instruction.entries]
    if instruction.kind == "join":
        return [bits for operand in operands for bits in operand]
    if instruction.kind in MATRICES:
        return [functools.reduce(operator.or_, operands[0], 0)] * instruction.size
    found = [0] * instruction.size
    for operand in operands:
        found = [bits | operand[place if len(operand) > 1 else 0] for place, bits in enumerate(found)]
    return found
