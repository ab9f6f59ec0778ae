"""A straight-line program of torch operations: what one step of a stranger's loop does, once it has been recorded.

Every slot holds a vector; the program runs on anything that answers torch's operations with the vector in the last
dimension and any batch in front: plain tensors, and every propagator's sets. It needs little of them:
``v[..., index]``, :func:`torch.cat` along the last dimension, :func:`torch.nn.functional.linear`, sums, products,
quotients and the functions that have a relaxation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sagemp_cli.errors import SagempError, UsageError


class Slot(NamedTuple):
    """The value of an earlier instruction."""

    index: int


@dataclass(frozen=True)
class Instruction:
    """``function(*operands, **options)``, slots among the operands and options standing for their values."""

    function: Callable[..., Any]
    operands: tuple[Any, ...]
    options: dict[str, Any]

    def run(self, values: Sequence[Any]) -> Any:
        """The result, from the values of all earlier slots."""
        operands = (values[o.index] if isinstance(o, Slot) else o for o in self.operands)
        options = {k: values[o.index] if isinstance(o, Slot) else o for k, o in self.options.items()}
        return self.function(*operands, **options)

    @property
    def sources(self) -> list[int]:
        """Slots that are read."""
        return [o.index for o in (*self.operands, *self.options.values()) if isinstance(o, Slot)]


@dataclass(frozen=True)
class Program:
    """``x_{k+1}`` from ``x_k (..., n)`` and ``w_k (..., d)``; slots 0 and 1 are the inputs.

    Attributes:
        instructions: one a slot from slot 2 on; None where nothing needs the slot.
        result: the slot of the next state, or the next state itself if it does not depend on the inputs.
    """

    instructions: tuple[Instruction | None, ...]
    result: Slot | Tensor

    def __call__(self, x: Any, w: Any) -> Any:
        """Run on tensors or sets."""
        if isinstance(self.result, Tensor):
            return x * 0.0 + self.result
        values = [x, w]
        for instruction in self.instructions:
            values.append(None if instruction is None else instruction.run(values))
        return values[self.result.index]


class Recorder:
    """Writes a program down while an example is computed.

    Every scalar that the example computes has a number (its id). A tensor of ids says where each of its entries comes
    from, so that whatever only moves entries is done by torch itself, on ids.

    Attributes:
        zero: the id of the constant 0, which is 0: operations that fill with zeros fill with it.
        unwritten: the id of an entry that has no value yet.
        refusal: the first error that said that the step cannot be bounded, should the step have caught it.
    """

    zero = 0
    unwritten = -1

    def __init__(self, x: Tensor, w: Tensor) -> None:
        self.refusal: SagempError | None = None
        self._instructions: list[Instruction | None] = []
        self._starts: list[int] = []
        self._constant: list[bool] = []
        self._examples: list[Tensor] = []
        self._table = torch.zeros(1, dtype=torch.float64)
        self._slots: dict[Any, int] = {}
        self._new(None, torch.zeros(1, dtype=torch.float64), constant=True)
        self.x = self._new(None, x.reshape(-1)).reshape(x.shape)
        self.w = self._new(None, w.reshape(-1)).reshape(w.shape)

    # -- ids -----------------------------------------------------------------------------------------------------------

    def constant(self, value: Tensor) -> Tensor:
        """Ids of constants, in the shape of ``value`` (float64)."""
        return self._new(None, value.detach().reshape(-1).clone(), constant=True).reshape(value.shape)

    def is_constant(self, ids: Tensor) -> bool:
        """Whether no entry depends on the inputs."""
        return bool(self.constant_entries(ids).all())

    def constant_entries(self, ids: Tensor) -> Tensor:
        """Which entries do not depend on the inputs."""
        self._check_written(ids)
        return torch.tensor(self._constant)[self._owners(ids)]

    def example(self, ids: Tensor) -> Tensor:
        """The numbers of the example, in the shape and strides of the ids; NaN where nothing was written."""
        return torch.where(ids < 0, torch.nan, self._table[ids.clamp(min=0)])

    # -- writing -------------------------------------------------------------------------------------------------------

    def operand(self, ids: Tensor, *, full: bool = False) -> Slot | Tensor:
        """What an instruction reads for these ids: a slot, or a tensor if all are constants.

        The vector has one entry per id, or a single one if all are equal and ``full`` is not asked for.
        """
        flat = ids.reshape(-1).contiguous()
        if self.is_constant(flat):
            return self._table[flat]
        unique, inverse = torch.unique(flat, return_inverse=True)
        slot = self._gathered(unique)
        if len(unique) == 1 and not full or torch.equal(inverse, torch.arange(len(unique))):
            return Slot(slot)
        return Slot(self._write_once(_pick, (Slot(slot), _selection(inverse))))

    def write(self, function: Callable[..., Any], *operands: Any, **options: Any) -> Tensor:
        """Append an instruction; ids ``(m,)`` of its result. Without a slot among the operands it gives constants."""
        instruction = Instruction(function, operands, options)
        value = instruction.run(self._examples)
        if not instruction.sources:
            return self.constant(value.to(torch.float64))
        return self._new(instruction, value)

    def finish(self, result: Tensor) -> Program:
        """The program whose result has these ids ``(n,)``; what the result does not need is dropped."""
        last = self.operand(result, full=True)
        if isinstance(last, Tensor):
            return Program((), last)
        # The program has the inputs first; constants are inside the instructions.
        order = [i for i in range(len(self._instructions)) if self._instructions[i] is not None]
        number = {1: 0, 2: 1} | {slot: 2 + i for i, slot in enumerate(order)}
        needed, pending = set(), [last.index]
        while pending:
            slot = pending.pop()
            if slot not in needed:
                needed.add(slot)
                instruction = self._instructions[slot]
                pending.extend([] if instruction is None else instruction.sources)

        def moved(o: Any) -> Any:
            return Slot(number[o.index]) if isinstance(o, Slot) else o

        def renumbered(slot: int) -> Instruction | None:
            old = self._instructions[slot]
            if old is None or slot not in needed:
                return None
            return Instruction(
                old.function, tuple(moved(o) for o in old.operands), {k: moved(o) for k, o in old.options.items()}
            )

        return Program(tuple(renumbered(slot) for slot in order), Slot(number[last.index]))

    # -- bookkeeping ---------------------------------------------------------------------------------------------------

    def _new(self, instruction: Instruction | None, value: Tensor, *, constant: bool = False) -> Tensor:
        start = self._starts[-1] + len(self._examples[-1]) if self._starts else 0
        self._instructions.append(instruction)
        self._starts.append(start)
        self._constant.append(constant)
        self._examples.append(value)
        stop = start + len(value)
        if stop > len(self._table):
            self._table = torch.cat([self._table, self._table.new_zeros(max(stop - len(self._table), 1024))])
        self._table[start:stop] = value
        return torch.arange(start, stop)

    def _owners(self, ids: Tensor) -> Tensor:
        return torch.bucketize(ids.contiguous(), torch.tensor(self._starts), right=True) - 1

    def _check_written(self, ids: Tensor) -> None:
        if ids.numel() and int(ids.min()) < 0:
            raise UsageError(
                "step reads an entry that was never written (torch.empty_like leaves entries without a value)"
            )

    def _gathered(self, unique: Tensor) -> int:
        """A slot whose entries are these ids, which are sorted."""
        owners = self._owners(unique)
        parts: list[Any] = []
        for owner in torch.unique(owners).tolist():
            mine = unique[owners == owner] - self._starts[owner]
            if self._constant[owner]:
                parts.append(self._examples[owner][mine])
            elif len(mine) == len(self._examples[owner]):
                parts.append(Slot(owner))
            else:
                parts.append(Slot(self._write_once(_pick, (Slot(owner), _selection(mine)))))
        return parts[0].index if len(parts) == 1 else self._write_once(_join, tuple(parts))

    def _write_once(self, function: Callable[..., Any], operands: tuple[Any, ...]) -> int:
        key = (function, *(tuple(o.tolist()) if isinstance(o, Tensor) else o for o in operands))
        if key not in self._slots:
            instruction = Instruction(function, operands, {})
            self._new(instruction, instruction.run(self._examples))
            self._slots[key] = len(self._instructions) - 1
        return self._slots[key]


class Run(NamedTuple):
    """Neighbouring entries of a vector."""

    first: int
    stop: int


def _selection(index: Tensor) -> Run | Tensor:
    """The same entries, as a run where they are one."""
    first, stop = int(index[0]), int(index[0]) + len(index)
    return Run(first, stop) if torch.equal(index, torch.arange(first, stop)) else index


def _pick(value: Any, entries: Run | Tensor) -> Any:
    if isinstance(entries, Run):
        return value[..., entries.first : entries.stop]
    return value.index_select(-1, entries) if isinstance(value, Tensor) else value[..., entries]


def _join(*parts: Any) -> Any:
    """Vectors one after the other; constants are repeated for the batch of the others."""
    batch = max((p.shape[:-1] for p in parts), key=len)
    return torch.cat([p if len(p.shape) > len(batch) else p.expand(*batch, p.shape[-1]) for p in parts], dim=-1)
