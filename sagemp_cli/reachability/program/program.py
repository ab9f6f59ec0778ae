"""A step of a closed loop as data: a short list of instructions on vectors of real numbers.

``docs/program.md`` is the specification. A program names no code: it is recorded from a loop, run by the propagators,
carried by a certificate, and evaluated by the checker, each with its own meaning of the same kinds.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from sagemp_cli.errors import UsageError
from sagemp_cli.reachability.program.kinds import (
    CONSTANTS,
    INPUTS,
    KINDS,
    MATRICES,
    OF_ONE,
    OF_THREE,
    OF_TWO,
    float32_linear,
    join,
    linear,
    pick,
)


@dataclass(frozen=True, eq=False)
class Instruction:
    """What makes one vector.

    Attributes:
        kind: one of :data:`~sagemp_cli.reachability.program.kinds.KINDS`.
        size: entries of the result.
        operands: the slots that are read, all of them earlier ones.
        constants: float64, taken as exact: see :data:`~sagemp_cli.reachability.program.kinds.CONSTANTS`.
        entries: of ``pick``, which.
    """

    kind: str
    size: int
    operands: tuple[int, ...] = ()
    constants: tuple[Tensor, ...] = ()
    entries: tuple[int, ...] = ()

    def on(self, *operands: Any) -> Any:
        """The result on tensors, from the operands' values ``(..., size)``."""
        if self.kind == "constant":
            return self.constants[0]
        if self.kind == "pick":
            return pick(operands[0], self.entries)
        if self.kind == "join":
            return join(operands)
        if self.kind in MATRICES:
            return (linear if self.kind == "linear" else float32_linear)(operands[0], *self.constants)
        return (OF_ONE.get(self.kind) or OF_TWO.get(self.kind) or OF_THREE[self.kind])(*operands, *self.constants)


Evaluate = Callable[[Instruction, Sequence[Any]], Any]
"""What an instruction makes of its operands' values."""


@dataclass(frozen=True, eq=False)
class Outputs:
    """What a step gives: slots of a program, or their values.

    Attributes:
        next: the next state, n entries.
        control: the control, if the loop says what it is.
        deviation: of a learned robot from its model, if it is asked for.
    """

    next: Any
    control: Any = None
    deviation: Any = None

    def of(self, values: Sequence[Any]) -> Outputs:
        """Values of these slots."""
        slots = (getattr(self, field.name) for field in fields(self))
        return Outputs(*(None if slot is None else values[slot] for slot in slots))


@dataclass(frozen=True, eq=False)
class Program:
    """One step, ``x_{k+1}`` and more from ``x_k``, ``w_k`` and the numbers that step k has of its own.

    Attributes:
        instructions: instruction i makes slot i; the inputs come first.
        outputs: slots.

    Raises:
        UsageError: it is no program; the message says which instruction is wrong and why.
    """

    instructions: tuple[Instruction, ...]
    outputs: Outputs

    def __post_init__(self) -> None:
        for slot, instruction in enumerate(self.instructions):
            wrong = _complaint(instruction, slot, self.instructions)
            if wrong:
                raise UsageError(f"step program: instruction {slot} ('{instruction.kind}') {wrong}")
        if not self.instructions or self.instructions[0].kind != "state" or "disturbance" not in self.kinds[1:2]:
            raise UsageError("step program: it must begin with 'state' and 'disturbance'")
        for name, size in (("next", self.states), ("control", None), ("deviation", self.states)):
            slot = getattr(self.outputs, name)
            if slot is None and name != "next":
                continue
            if not isinstance(slot, int) or not 0 <= slot < len(self.instructions):
                raise UsageError(f"step program: output '{name}' must be a slot, found {slot!r}")
            if size is not None and self.instructions[slot].size != size:
                raise UsageError(
                    f"step program: output '{name}' has {self.instructions[slot].size} entries, the state {size}"
                )

    @functools.cached_property
    def kinds(self) -> tuple[str, ...]:
        """Of all instructions."""
        return tuple(i.kind for i in self.instructions)

    def _size_of(self, kind: str) -> int:
        return next((i.size for i in self.instructions if i.kind == kind), 0)

    @property
    def states(self) -> int:
        """Number of states n."""
        return self._size_of("state")

    @property
    def disturbances(self) -> int:
        """Entries of a disturbance, d."""
        return self._size_of("disturbance")

    @property
    def numbers(self) -> int:
        """Numbers that a step has of its own, g."""
        return self._size_of("numbers")

    def run(self, state: Any, disturbance: Any, numbers: Any = None, *, evaluate: Evaluate | None = None) -> Outputs:
        """What a step gives: of tensors ``(..., n)``, ``(..., d)``, ``(..., g)``, which broadcast; or of sets.

        Args:
            state, disturbance, numbers: values of the inputs.
            evaluate: what the other instructions do, on values of one's own; on tensors by default.
        """
        given = {"state": state, "disturbance": disturbance, "numbers": numbers}
        values: list[Any] = []
        for instruction in self.instructions:
            if instruction.kind in INPUTS:
                values.append(given[instruction.kind])
                continue
            operands = [values[slot] for slot in instruction.operands]
            values.append(instruction.on(*operands) if evaluate is None else evaluate(instruction, operands))
        outputs = self.outputs.of(values)
        after = outputs.next
        if evaluate is None and after.dim() < state.dim():  # a constant has no batch
            return replace(outputs, next=after.expand(state.shape))
        return outputs

    def same_as(self, other: Program) -> bool:
        """Whether both are the same, number by number."""

        def key(i: Instruction) -> Any:
            return i.kind, i.size, i.operands, i.entries, len(i.constants)

        return (
            len(self.instructions) == len(other.instructions)
            and vars(self.outputs) == vars(other.outputs)
            and all(
                key(a) == key(b) and all(map(torch.equal, a.constants, b.constants))
                for a, b in zip(self.instructions, other.instructions, strict=True)
            )
        )


def program_of(
    instructions: Sequence[Instruction], inputs: Iterable[int], outputs: Mapping[str, int | None]
) -> Program:
    """The program of instructions that may have come in any order that is one of evaluation: without what no output
    needs, and with the inputs first.

    Args:
        instructions: instruction i makes slot i.
        inputs: slots of the inputs, which stay even where nothing reads them.
        outputs: slots by name; None where there is none.
    """
    first = sorted(inputs)
    needed, pending = set(first), [slot for slot in outputs.values() if slot is not None]
    while pending:
        slot = pending.pop()
        if slot not in needed:
            needed.add(slot)
            pending.extend(instructions[slot].operands)
    order = [*first, *sorted(needed.difference(first))]
    number = {slot: i for i, slot in enumerate(order)}
    kept = (instructions[slot] for slot in order)
    return Program(
        tuple(replace(i, operands=tuple(number[o] for o in i.operands)) for i in kept),
        Outputs(**{name: None if slot is None else number[slot] for name, slot in outputs.items()}),
    )


def _complaint(i: Instruction, slot: int, before: Sequence[Instruction]) -> str | None:
    """What is wrong with an instruction."""
    if i.kind not in KINDS:
        return f"is none of {', '.join(KINDS)}"
    if i.kind in INPUTS and slot != INPUTS.index(i.kind):
        return "must be among the first, in the order state, disturbance, numbers"
    if any(not 0 <= o < slot for o in i.operands):
        return f"reads slots {list(i.operands)}, allowed are earlier ones"
    if i.kind not in (*INPUTS, "constant") and all(before[o].kind == "constant" for o in i.operands):
        return "reads constants only, which are one constant"
    sizes = [before[o].size for o in i.operands]
    count = {"pick": 1, **dict.fromkeys(MATRICES, 1), "join": max(len(sizes), 1)}.get(
        i.kind, (i.kind in OF_ONE) + 2 * (i.kind in OF_TWO) + 3 * (i.kind in OF_THREE)
    )
    if len(sizes) != count:
        return f"reads {len(sizes)} slots, expected {count}"
    if i.size < 0 or (i.size == 0 and i.kind != "numbers"):
        return f"has {i.size} entries"
    made = {
        "pick": len(i.entries),
        "join": sum(sizes),
        **dict.fromkeys(MATRICES, i.size),
    }.get(i.kind, max(sizes, default=i.size))
    if i.size != made or (len(sizes) > 1 and i.kind != "join" and not set(sizes) <= {1, made}):
        return f"makes {i.size} entries of {sizes}"
    if any(not 0 <= e < sizes[0] for e in i.entries) or (i.entries and i.kind != "pick"):
        return "picks entries that are not there"
    return _complaint_of_constants(i, sizes)


def _complaint_of_constants(i: Instruction, sizes: Sequence[int]) -> str | None:
    names = CONSTANTS.get(i.kind, ())
    if len(i.constants) != len(names):
        return f"has {len(i.constants)} constants, expected {len(names)}"
    for name, value in zip(names, i.constants, strict=True):
        shape = {"matrix": (i.size, *sizes)}.get(
            name, (i.size,) if name in ("bias", "the vector", "lower", "upper") else ()
        )
        if value.shape != shape or value.dtype != torch.float64:
            return f"has {name} {tuple(value.shape)} {value.dtype}, expected {tuple(shape)} torch.float64"
        if bool(torch.isnan(value).any()) or (i.kind != "clamp" and not bool(torch.isfinite(value).all())):
            return f"has a {name} that is not finite"
    numbers = [float(c) for c in i.constants if not c.dim()]
    if i.kind == "leaky_relu" and numbers[0] > 1:
        return f"has slope {numbers[0]}, allowed is at most 1"
    if i.kind == "elu" and not numbers[0] > 0:
        return f"has alpha {numbers[0]}, allowed is a positive one"
    if i.kind in ("remainder", "fmod") and not numbers[0] > 0:
        return f"has period {numbers[0]}, allowed is a positive one"
    if i.kind == "softplus" and not numbers[0] > 0:
        return f"has beta {numbers[0]}, allowed is a positive one"
    if i.kind == "pow" and (abs(numbers[0]) >= 2**31 or numbers[0] in (0, 1)):
        return f"has exponent {numbers[0]}, allowed are those below 2^31 in size other than 0 and 1"
    return None
