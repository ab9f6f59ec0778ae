"""A step program as arrays, to be written into an artifact, and back; ``docs/program.md`` has the layout."""

from __future__ import annotations

from collections.abc import Iterable, Sequence, Sized

import numpy as np
import torch

from sagemp_cli.errors import ArtifactError, UsageError
from sagemp_cli.reachability.program.kinds import MATRICES
from sagemp_cli.reachability.program.program import Instruction, Outputs, Program
from sagemp_cli.storage.kinds import ProgramRecord


def to_record(program: Program) -> ProgramRecord:
    """The program as arrays; no number is changed."""
    instructions = program.instructions
    numbers = [
        np.concatenate([np.zeros(0), *(c.detach().numpy().reshape(-1) for c in i.constants)]) for i in instructions
    ]
    outputs = (program.outputs.next, program.outputs.control, program.outputs.deviation)
    return ProgramRecord(
        kinds=tuple(i.kind for i in instructions),
        sizes=_integers(i.size for i in instructions),
        operand_begin=_begin([i.operands for i in instructions]),
        operands=_integers(o for i in instructions for o in i.operands),
        number_begin=_begin(numbers),
        numbers=np.concatenate(numbers),
        index_begin=_begin([i.entries for i in instructions]),
        indices=_integers(e for i in instructions for e in i.entries),
        outputs=_integers(-1 if slot is None else slot for slot in outputs),
    )


def from_record(record: ProgramRecord) -> Program:
    """The program of arrays that may come from anywhere.

    Raises:
        ArtifactError: they are no program; the message names the instruction.
    """
    parts = [
        _parts(begin, whole, name)
        for begin, whole, name in (
            (record.operand_begin, record.operands, "operand"),
            (record.number_begin, record.numbers, "number"),
            (record.index_begin, record.indices, "index"),
        )
    ]
    if len(record.outputs) != 3:
        raise ArtifactError(f"step program: {len(record.outputs)} outputs, expected 3")
    try:
        instructions: list[Instruction] = []
        for kind, size, operands, numbers, entries in zip(record.kinds, record.sizes.tolist(), *parts, strict=True):
            slots = tuple(operands.tolist())
            wide = [instructions[o].size for o in slots if 0 <= o < len(instructions)]
            constants = _constants(kind, size, wide, numbers)
            instructions.append(Instruction(kind, size, slots, constants, tuple(entries.tolist())))
        return Program(tuple(instructions), Outputs(*(None if slot < 0 else slot for slot in record.outputs.tolist())))
    except ArtifactError:
        raise
    except UsageError as error:
        raise ArtifactError(str(error)) from error


def _integers(values: Iterable[int]) -> np.ndarray:
    return np.array(list(values), dtype=np.int64)


def _begin(parts: Iterable[Sized]) -> np.ndarray:
    return np.concatenate([[0], np.cumsum([len(part) for part in parts])]).astype(np.int64)


def _parts(begin: np.ndarray, whole: np.ndarray, name: str) -> list[np.ndarray]:
    if begin[0] != 0 or begin[-1] != len(whole) or bool((np.diff(begin) < 0).any()):
        raise ArtifactError(f"step program: '{name}_begin' does not divide what it should")
    return np.split(whole, begin[1:-1])


def _constants(kind: str, size: int, operands: Sequence[int], numbers: np.ndarray) -> tuple[torch.Tensor, ...]:
    """An instruction's constants, shaped by its kind; that they are right is the program's to say."""
    flat = torch.from_numpy(np.array(numbers, dtype=np.float64))
    if kind in MATRICES and len(operands) == 1 and len(flat) == size * (operands[0] + 1):
        return flat[:-size].reshape(size, operands[0]), flat[-size:]
    if kind == "clamp" and len(flat) == 2 * size:
        return flat[:size], flat[size:]
    if kind == "constant":
        return (flat,)
    return tuple(flat)
