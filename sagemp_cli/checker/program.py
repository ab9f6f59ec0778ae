"""The step of a certificate as data: instructions on vectors, read from untrusted numbers and checked for sense.

``docs/program.md`` is the specification; nothing here computes. What is known of a program without running it, the
width of every slot, what it depends on and which relaxations a proof needs, is found here once.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

INPUTS = ("state", "disturbance", "numbers")
MOVES = ("pick", "join", "linear", "add", "sub", "neg")
SCALARS = (
    "sin", "cos", "tan", "atan", "tanh", "sigmoid", "silu", "gelu", "gelu_tanh", "mish", "softsign", "hardswish", "erf",
    "exp", "log", "sqrt", "abs", "reciprocal", "relu", "floor", "ceil", "round", "trunc", "sign", "positive", "wrap",
)  # fmt: skip
WITH_NUMBERS: Mapping[str, int] = {"leaky_relu": 1, "elu": 1, "softplus": 2, "pow": 1, "remainder": 1, "fmod": 1}
"""Functions of one value that have constants, and how many."""
PAIRS = ("add", "sub", "mul", "div", "maximum", "minimum", "atan2", "logaddexp")
TRIPLES = ("where",)
FLOAT32 = ("float32", "float32_near", "float32_linear")
"""What stands for float32 arithmetic; docs/program.md says what it may give."""
MATRICES = ("linear", "float32_linear")
UNARY = ("pick", *MATRICES, "float32", "float32_near", "neg", "clamp", "identity", *SCALARS, *WITH_NUMBERS)

KINDS = (*INPUTS, "constant", "join", *UNARY, *PAIRS, *TRIPLES)
"""All kinds of instructions."""

_MOST_INSTRUCTIONS = 10_000
_MOST_ENTRIES = 200_000
_MOST_NUMBERS = 20_000_000
"""Of the rows of all slots together; a network of three layers of 64 has 200,000."""
_LARGEST_POWER = 2**31


@dataclass(frozen=True)
class Instruction:
    """One line of a program.

    Attributes:
        kind: what it does.
        reads: slots of earlier instructions.
        constants: float64 numbers.
        entries: of a ``pick``, which entries it takes.
    """

    kind: str
    reads: tuple[int, ...] = ()
    constants: np.ndarray = field(default_factory=lambda: np.zeros(0))
    entries: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))


@dataclass(frozen=True)
class Program:
    """A step ``x_{k+1} = step(x_k, w_k)`` that makes sense; see :meth:`of`.

    Attributes:
        instructions: one a slot.
        widths: entries of each slot.
        depends: whether a slot depends on an input of the step.
        relaxed: name and number of entries of the relaxations that each slot takes, in order.
        next, control, deviation: output slots; of those that there are none, -1.
        states, disturbances, numbers: n, d, g.
    """

    instructions: tuple[Instruction, ...]
    widths: tuple[int, ...]
    depends: tuple[bool, ...]
    relaxed: tuple[tuple[tuple[str, int], ...], ...]
    next: int
    control: int
    deviation: int
    states: int
    disturbances: int
    numbers: int

    @classmethod
    def of(
        cls, instructions: Sequence[Instruction], outputs: Mapping[str, int], *, states: int, disturbances: int,
        numbers: int,
    ) -> Program:  # fmt: skip
        """Check that every instruction is one of the specification.

        Args:
            instructions: one a slot.
            outputs: slots of ``next`` and perhaps ``control`` and ``deviation``.
            states, disturbances, numbers: sizes of the inputs.

        Raises:
            ValueError: one is not, or the program is larger than any step that can be checked.
        """
        sizes = {"state": states, "disturbance": disturbances, "numbers": numbers}
        if len(instructions) > _MOST_INSTRUCTIONS:
            raise ValueError(f"the program has {len(instructions)} instructions, more than {_MOST_INSTRUCTIONS}")
        widths: list[int] = []
        depends: list[bool] = []
        relaxed: list[tuple[tuple[str, int], ...]] = []
        for slot, instruction in enumerate(instructions):
            try:
                if instruction.kind in INPUTS and slot != INPUTS.index(instruction.kind):
                    raise ValueError("the inputs come first: state, disturbance, numbers")
                if not all(0 <= r < slot for r in instruction.reads):
                    raise ValueError(f"it reads slots {_few(instruction.reads)}, only earlier ones are there")
                widths.append(_width(instruction, [widths[r] for r in instruction.reads], sizes))
                depends.append(instruction.kind in INPUTS or any(depends[r] for r in instruction.reads))
                relaxed.append(_relaxations(instruction, widths, depends))
            except ValueError as e:
                raise ValueError(f"slot {slot} of the program ({instruction.kind[:20]}): {e}") from None
            if sum(widths) > _MOST_ENTRIES:
                raise ValueError(f"the program has more than {_MOST_ENTRIES} entries")
        if [i.kind for i in instructions[:2]] != ["state", "disturbance"]:
            raise ValueError("the program does not begin with 'state' and 'disturbance'")
        if not set(outputs) <= {"next", "control", "deviation"} or "next" not in outputs:
            raise ValueError("the program's outputs are next, and perhaps control and deviation")
        if not all(0 <= slot < len(widths) for slot in outputs.values()):
            raise ValueError(f"the program has {len(widths)} slots, its outputs are {_few(outputs.values())}")
        for name in ("next", "deviation"):
            if name in outputs and widths[outputs[name]] != states:
                raise ValueError(f"'{name}' of the program has {widths[outputs[name]]} entries, {states} are needed")
        program = cls(
            tuple(instructions), tuple(widths), tuple(depends), tuple(relaxed),
            outputs["next"], outputs.get("control", -1), outputs.get("deviation", -1), states, disturbances, numbers,
        )  # fmt: skip
        program._require_small()
        return program

    @property
    def relaxations(self) -> int:
        """Entries of all that is recorded of a step, E."""
        return sum(count for slot in self.relaxed for _, count in slot)

    @property
    def variables(self) -> int:
        """How many variables these add; a direction and a ratio add none."""
        return sum(count for slot in self.relaxed for name, count in slot if name not in ("direction", "ratio"))

    @property
    def controls(self) -> int:
        """Entries of the control, m; 0 if there is none."""
        return self.widths[self.control] if self.control >= 0 else 0

    @property
    def reads_disturbance(self) -> bool:
        """Whether slot 1, the disturbance, is read or an output."""
        return 1 in (self.next, self.control, self.deviation) or any(1 in i.reads for i in self.instructions)

    def fingerprint(self) -> str:
        """SHA-256 of everything in it, hexadecimal."""
        digest = hashlib.sha256(repr((self.next, self.control, self.deviation)).encode())
        for i in self.instructions:
            head = repr((i.kind, i.reads, len(i.constants), len(i.entries)))
            digest.update(head.encode() + i.constants.tobytes() + i.entries.tobytes())
        return digest.hexdigest()

    def is_deviating(self, other: Program) -> bool:
        """Whether this step is the other one with its deviation added to the disturbance, and the control is the same:
        instruction by instruction, through an ``identity``.
        """
        ids: dict[tuple[Any, ...], int] = {}
        own = _numbered(self, ids, {})
        for slot, instruction in enumerate(self.instructions):
            if instruction.kind == "add" and instruction.reads[0] == 1:  # slot 1 is the disturbance
                fold = self.instructions[instruction.reads[1]]
                if fold.kind == "identity" and fold.reads == (self.deviation,):
                    found = _numbered(other, ids, {1: own[slot]})
                    same = (self.control < 0) == (other.control < 0)
                    same &= self.control < 0 or own[self.control] == found[other.control]
                    if same and own[self.next] == found[other.next]:
                        return True
        return False

    def _require_small(self) -> None:
        """Refuse what would need far more room than any step that can be checked: all rows at full length."""
        variables = 1 + self.states + self.disturbances + self.numbers
        total = 0
        for width, relaxed in zip(self.widths, self.relaxed, strict=True):
            variables += sum(count for _, count in relaxed)
            total += width * variables
        if total > _MOST_NUMBERS:
            raise ValueError(f"the program's values are {total} numbers, more than {_MOST_NUMBERS}")


def _numbered(program: Program, ids: dict[tuple[Any, ...], int], given: Mapping[int, int]) -> list[int]:
    """A number for each slot, the same for the same instruction on the same values."""
    out: list[int] = []
    for slot, i in enumerate(program.instructions):
        key = (i.kind, tuple(out[r] for r in i.reads), i.constants.tobytes(), i.entries.tobytes())
        out.append(given[slot] if slot in given else ids.setdefault(key, len(ids)))
    return out


_ALLOWED: Mapping[str, tuple[Callable[[float], bool], str]] = {
    "leaky_relu": (lambda s: s <= 1, "a slope of at most 1"),
    "elu": (lambda a: a > 0, "a positive alpha"),
    "softplus": (lambda b: b > 0, "a positive beta"),
    "pow": (lambda p: p not in (0, 1) and abs(p) < _LARGEST_POWER, "an exponent but 0 and 1 below 2^31 in size"),
    "remainder": (lambda m: m > 0, "a positive period"),
    "fmod": (lambda m: m > 0, "a positive period"),
}


def _width(instruction: Instruction, read: Sequence[int], sizes: Mapping[str, int]) -> int:
    """Entries of an instruction's result."""
    kind, constants, count = instruction.kind, instruction.constants, len(instruction.constants)
    wanted = 0 if kind in INPUTS or kind == "constant" else 2 if kind in PAIRS else 3 if kind in TRIPLES else 1
    if kind not in KINDS:
        raise ValueError("there is no such instruction")
    if kind == "join":
        wanted = max(len(read), 1)
    if len(read) != wanted:
        raise ValueError(f"it reads {len(read)} slots, {wanted} are needed")
    if len(instruction.entries) and kind != "pick":
        raise ValueError("only 'pick' has entries")
    if kind != "clamp" and not np.isfinite(constants).all():
        raise ValueError("its constants must be finite")
    if kind == "constant":
        width = count
    elif kind in MATRICES:
        width, left = divmod(count, read[0] + 1)
        if left:
            raise ValueError(f"{count} constants are no matrix and bias of an operand of {read[0]} entries")
    elif kind == "clamp":
        width = read[0]
        lower, upper = constants[: count // 2], constants[count // 2 :]
        if count != 2 * width or not ((lower < math.inf) & (upper > -math.inf)).all():  # false for NaN too
            raise ValueError(f"it needs {width} lower and {width} upper limits that are numbers")
    elif count != WITH_NUMBERS.get(kind, 0):
        raise ValueError(f"it has {count} constants, {WITH_NUMBERS.get(kind, 0)} are needed")
    elif kind in INPUTS:
        width = sizes[kind]
    elif kind == "pick":
        width = len(instruction.entries)
        if width and not (instruction.entries.min() >= 0 and instruction.entries.max() < read[0]):
            raise ValueError(f"it picks entries that an operand of {read[0]} does not have")
    elif kind == "join":
        width = sum(read)
    elif kind in PAIRS or kind in TRIPLES:
        width = max(read)
        if not {1, width} >= set(read):
            raise ValueError(f"its operands have {' and '.join(map(str, read))} entries")
    else:
        width = read[0]
    if kind in _ALLOWED and not _ALLOWED[kind][0](constants[0]):
        raise ValueError(f"it needs {_ALLOWED[kind][1]}, found {constants[0]}")
    if width < (0 if kind == "numbers" else 1):
        raise ValueError("its result has no entries")
    return width


def _relaxations(
    instruction: Instruction, widths: Sequence[int], depends: Sequence[bool]
) -> tuple[tuple[str, int], ...]:
    """Name and number of entries of the relaxations that the last instruction takes."""
    kind, width = instruction.kind, widths[-1]
    given = [depends[r] for r in instruction.reads]
    if not any(given) or kind in MOVES or (kind == "mul" and not all(given)):
        return ()
    if kind == "mul":
        return (("product", width),)
    if kind == "div":
        divisor = (("reciprocal", widths[instruction.reads[1]]),) if given[1] else ()
        return (*divisor, ("product", width)) if all(given) else divisor
    if kind in ("maximum", "minimum"):
        return (("relu" if all(given) else "clamp", width),)
    if kind == "logaddexp":
        return (("softplus", width),)
    beside = {"atan2": (("direction", width),), "where": (("ratio", width),)}.get(kind, ())
    return ((kind, width), *beside)


def _few(slots: Sequence[int] | object) -> str:
    found = [str(s) for s in slots]  # type: ignore[attr-defined]
    return ", ".join(found[:4]) + (", ..." if len(found) > 4 else "")
