"""Programs that the checker writes itself, from those of a file: a period of an ODE, its Taylor coefficients.

The rules of writing are those of ``docs/continuous_time.md``: what is there already is not written again, nothing is
computed, and what no output needs is dropped at the end.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sagemp_cli.checker.program import INPUTS, MATRICES, Instruction, Program

_MOST_LINES = 40_000
"""More than a program may keep; one that is longer while it is written is given up."""


class Writer:
    """Lines so far; a value is the number of its line.

    Args:
        states, disturbances, numbers: entries of the inputs; no numbers if 0.
    """

    state, disturbance = 0, 1

    def __init__(self, states: int, disturbances: int, numbers: int = 0) -> None:
        self.sizes = (states, disturbances, numbers)
        self.numbers = 2 if numbers else None
        self._lines = [Instruction(kind) for kind in INPUTS[: 3 if numbers else 2]]
        self.widths = list(self.sizes[: len(self._lines)])
        self._found: dict[tuple[object, ...], int] = {}

    def constant(self, values: Sequence[float] | np.ndarray) -> int:
        """Numbers."""
        return self._line("constant", (), np.asarray(values, np.float64), (), len(values))

    def put(
        self, kind: str, *reads: int, constants: np.ndarray | None = None, entries: Sequence[int] = ()
    ) -> int:  # fmt: skip
        """An instruction; of constants only it reads the first as a ``linear`` of the state that does not look at it.

        Raises:
            ValueError: there are too many.
        """
        if all(self._lines[r].kind == "constant" for r in reads):
            values = self._lines[reads[0]].constants
            blind = np.concatenate([np.zeros(len(values) * self.sizes[0]), values])
            reads = self._line("linear", (self.state,), blind, (), len(values)), *reads[1:]
        given = np.zeros(0) if constants is None else constants
        widths = [self.widths[r] for r in reads]
        width = max(widths)
        if kind == "pick":
            width = len(entries)
        elif kind == "join":
            width = sum(widths)
        elif kind in MATRICES:
            width = len(given) // (widths[0] + 1)
        return self._line(kind, tuple(reads), given, tuple(entries), width)

    def copy(self, instruction: Instruction, reads: Sequence[int]) -> int:
        """An instruction of another program, on values of this one."""
        if instruction.kind == "constant":
            return self.constant(instruction.constants)
        return self.put(instruction.kind, *reads, constants=instruction.constants, entries=instruction.entries.tolist())

    def part(self, value: int, first: int, count: int) -> int:
        """Some entries in a row."""
        whole = count == self.widths[value]
        return value if whole else self.put("pick", value, entries=range(first, first + count))

    def join(self, values: Sequence[int]) -> int:
        """Values one after the other."""
        return values[0] if len(values) == 1 else self.put("join", *values)

    def times(self, value: int, factor: float) -> int:
        """A multiple."""
        return value if factor == 1 else self.put("mul", value, self.constant([factor]))

    def over(self, value: int, divisor: float) -> int:
        """A fraction."""
        return value if divisor == 1 else self.put("div", value, self.constant([divisor]))

    def finished(self, outputs: Mapping[str, int]) -> Program:
        """The program, without what no output needs.

        Raises:
            ValueError: it is larger than any that can be checked.
        """
        wanted = {*range(3 if self.numbers else 2), *outputs.values()}
        for slot in range(len(self._lines) - 1, -1, -1):
            if slot in wanted:
                wanted.update(self._lines[slot].reads)
        place = {slot: i for i, slot in enumerate(sorted(wanted))}
        lines = [
            Instruction(line.kind, tuple(place[r] for r in line.reads), line.constants, line.entries)
            for line in (self._lines[slot] for slot in place)
        ]
        n, d, g = self.sizes
        named = {name: place[slot] for name, slot in outputs.items()}
        return Program.of(lines, named, states=n, disturbances=d, numbers=g)

    def _line(
        self, kind: str, reads: tuple[int, ...], constants: np.ndarray, entries: tuple[int, ...], width: int
    ) -> int:  # fmt: skip
        key = (kind, width, reads, entries, constants.tobytes())
        if key not in self._found:
            if len(self._lines) >= _MOST_LINES:
                raise ValueError(f"a period of this ODE takes more than {_MOST_LINES} instructions")
            self._found[key] = len(self._lines)
            self._lines.append(Instruction(kind, reads, constants, np.array(entries, np.int64)))
            self.widths.append(width)
        return self._found[key]
