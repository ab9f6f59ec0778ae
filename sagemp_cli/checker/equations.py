"""A program as equations for people: names of states and controls, numbers where they are few, else their size.

What is shown is rounded to six digits and proves nothing; the numbers themselves are in the file.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sagemp_cli.checker.program import MATRICES, PAIRS, Instruction, Program

_SMALL = 24  # entries of a vector that are shown one by one
_MATRIX = 64  # numbers of a matrix that are shown one by one
_SHORT = 80  # characters that may stand inside another expression
_BRIEF = 16  # that may stand there more than once
_MOST_LINES = 400
_SIGNS = {"add": "+", "sub": "-", "mul": "*", "div": "/"}


@dataclass(frozen=True)
class Names:
    """What inputs and outputs are called.

    Attributes:
        states, controls: n and m names.
        disturbances: d names.
    """

    states: Sequence[str]
    controls: Sequence[str]
    disturbances: Sequence[str]


def equations(program: Program, names: Names) -> list[str]:
    """One line for each output of a step and each value in between that is used more than once or is long.

    ``x'`` is the state after the step, ``ref`` the list of numbers that the step has of its own.
    """
    writer = _Writer(program, names)
    return [*writer.lines(), *writer.after()]


def control_equations(program: Program, names: Names) -> list[str]:
    """The same of a control alone."""
    return _Writer(program, names).lines()


def rate_equations(program: Program, names: Names) -> list[str]:
    """The same of a right-hand side of an ODE: ``x'`` is the rate of the state, with the disturbances that have a name
    added to it."""
    writer = _Writer(program, names, numbers=names.controls)
    return [*writer.lines(), *writer.after(plus=names.disturbances)]


def margin_equations(program: Program, names: Names) -> list[str]:
    """The same of the margins of a requirement, which are called ``g``; those come last, one line each."""
    labels = [f"g{i + 1}" for i in range(program.controls)] if program.controls > 1 else ["g"]
    writer = _Writer(program, Names(names.states, labels, names.disturbances))
    return writer.margins()


@dataclass
class _Writer:
    program: Program
    names: Names
    numbers: Sequence[str] = ()
    out: list[str] = field(default_factory=list)
    texts: dict[int, list[str] | str] = field(default_factory=dict)

    def lines(self) -> list[str]:
        program = self.program
        uses = [0] * len(program.widths)
        for instruction in program.instructions:
            for r in instruction.reads:
                uses[r] += 1
        for slot, instruction in enumerate(program.instructions):
            if len(self.out) > _MOST_LINES:
                return [*self.out, f"... {len(program.widths) - slot} more instructions"]
            text = self._text(slot, instruction)
            if slot == program.control:
                text = self._controls(text)
            elif isinstance(text, list) and slot != program.next and instruction.kind not in _PLAIN:
                text = self._named(slot, text, often=uses[slot] > 1)
            self.texts[slot] = text
        return self.out

    def after(self, plus: Sequence[str] = ()) -> list[str]:
        """Of the next state, to which something may be added, and the deviation; what comes after all else."""
        program, before = self.program, len(self.out)
        if program.next not in self.texts:
            return []
        after = self.texts[program.next]
        if isinstance(after, str):
            self.out.append(f"x' = {after}{' + w' if any(plus) else ''}")
        else:
            after = [
                _sum([text, w], 0.0) if w else text for text, w in zip(after, plus or [""] * len(after), strict=True)
            ]
            self._say((f"{name}'", text) for name, text in zip(self.names.states, after, strict=True))
        if program.deviation >= 0:
            found = self.texts[program.deviation]
            self._say([("deviation", found if isinstance(found, str) else f"({', '.join(found)})")])
        return self.out[before:]

    def margins(self) -> list[str]:
        """Of its output ``control`` one line each, after all that they are made of."""
        program, names = self.program, list(self.names.controls)
        made = dataclasses.replace(self, program=dataclasses.replace(program, control=-1, next=program.control))
        lines, text = made.lines(), made.texts[program.control]
        if isinstance(text, str):
            return [*lines, *(f"{name} = {text}[{i}]" for i, name in enumerate(names))]
        return [*lines, *(f"{name} = {entry}" for name, entry in zip(names, text, strict=True))]

    def _say(self, pairs) -> None:
        self.out += [f"{name} = {text}" for name, text in pairs if name != text]

    def _controls(self, text: list[str] | str) -> list[str] | str:
        """The controls by name, from here on."""
        names = list(self.names.controls)
        if isinstance(text, str):
            self.out.append(f"({', '.join(names)}) = {text}")
        else:
            self._say(zip(names, text, strict=True))
        return names

    def _named(self, slot: int, text: list[str], *, often: bool) -> list[str]:
        """Entries that are long, or used often and not short, get a name and a line of their own."""
        keep = [len(t) > (_BRIEF if often else _SHORT) for t in text]
        self._say((self._name(slot, i), t) for i, t in enumerate(text) if keep[i])
        return [self._name(slot, i) if keep[i] else t for i, t in enumerate(text)]

    def _name(self, slot: int, i: int) -> str:
        return f"s{slot}" if self.program.widths[slot] == 1 else f"s{slot}[{i}]"

    def _vector(self, slot: int, text: str) -> str:
        """A long vector gets a name and a line of its own, the control its names."""
        if slot == self.program.control:
            return text
        self.out.append(f"s{slot} = {text}    [{self.program.widths[slot]}]")
        return f"s{slot}"

    def _text(self, slot: int, instruction: Instruction) -> list[str] | str:
        """Each entry, or of a long vector its name."""
        kind, width = instruction.kind, self.program.widths[slot]
        if kind in ("state", "disturbance"):
            names = list(self.names.states if kind == "state" else self.names.disturbances)
            return names if width <= _SMALL else self._vector(slot, f"({', '.join(names)})")
        if kind == "numbers" and self.numbers:
            return list(self.numbers) if width <= _SMALL else self._vector(slot, f"({', '.join(self.numbers)})")
        if kind == "numbers":
            return "ref" if width != 1 else ["ref"]
        operands = [self.texts[r] for r in instruction.reads]
        large = kind in MATRICES and len(instruction.constants) > _MATRIX
        if kind == "constant" and (width > _SMALL or len(set(instruction.constants.tolist())) == 1 < width):
            values = [_number(c) for c in instruction.constants]
            return values[0] if len(set(values)) == 1 else self._vector(slot, f"({_few(values)})")
        if width > _SMALL or large or any(isinstance(o, str) for o in operands):
            taken = self._taken(instruction, operands)
            return taken if taken is not None else self._vector(slot, self._long(slot, instruction, operands))
        return self._entries(slot, instruction, operands)  # type: ignore[arg-type]

    def _taken(self, instruction: Instruction, operands: Sequence[list[str] | str]) -> list[str] | None:
        """Few entries of a long vector."""
        if instruction.kind != "pick" or len(instruction.entries) > _SMALL:
            return None
        source = operands[0]
        return [f"{source}[{i}]" if isinstance(source, str) else source[i] for i in instruction.entries]

    def _entries(self, slot: int, instruction: Instruction, operands: Sequence[list[str]]) -> list[str]:
        kind, width = instruction.kind, self.program.widths[slot]
        constants = [_number(c) for c in instruction.constants]
        if kind == "constant":
            return constants
        if kind == "pick":
            return [operands[0][i] for i in instruction.entries]
        if kind == "join":
            return [t for o in operands for t in o]
        if kind in MATRICES:
            matrix, bias = matrix_of(instruction, len(operands[0]))
            sums = [_sum([_times(_number(w), t) for w, t in zip(row, operands[0], strict=True) if w], b)
                    for row, b in zip(matrix, bias, strict=True)]  # fmt: skip
            return sums if kind == "linear" else [f"float32({text})" for text in sums]
        if kind in PAIRS:
            a, b = (list(o) * (width if len(o) == 1 else 1) for o in operands)
            return [_pair(kind, x, y) for x, y in zip(a, b, strict=True)]
        if kind == "where":
            parts = zip(*(list(o) * (width if len(o) == 1 else 1) for o in operands), strict=True)
            return [f"where({c} > 0, {x}, {y})" for c, x, y in parts]
        if kind == "neg":
            return [f"-{_factor(t)}" for t in operands[0]]
        if kind == "identity":
            return list(operands[0])
        if kind == "reciprocal":
            return [f"1 / {_factor(t)}" for t in operands[0]]
        if kind == "pow":
            return [f"{_factor(t)}^{constants[0]}" for t in operands[0]]
        if kind == "clamp":
            limits = zip(constants[:width], constants[width:], strict=True)
            return [f"clamp({t}, {low}, {high})" for t, (low, high) in zip(operands[0], limits, strict=True)]
        more = "".join(f", {c}" for c in constants)
        return [f"{kind}({t}{more})" for t in operands[0]]

    def _long(self, slot: int, instruction: Instruction, operands: Sequence[list[str] | str]) -> str:
        """A vector as a whole."""
        kind = instruction.kind
        whole = [o if isinstance(o, str) else f"({_few(o)})" if len(o) > 1 else o[0] for o in operands]
        if kind == "constant":
            return f"({_few([_number(c) for c in instruction.constants])})"
        if kind == "pick":
            return f"{whole[0]}[{_few([str(i) for i in instruction.entries])}]"
        if kind == "join":
            return f"({', '.join(_few(o) if isinstance(o, list) else o for o in operands)})"
        if kind in MATRICES:
            columns = self.program.widths[instruction.reads[0]]
            matrix, bias = matrix_of(instruction, columns)
            size = f"{matrix.shape[0]} x {matrix.shape[1]}"
            shift = f" + b{slot}" if bias.any() else ""
            product = f"M{slot} {whole[0]}{shift}"
            product = product if kind == "linear" else f"float32({product})"
            return f"{product}, M{slot} {size} up to {np.abs(matrix).max():.3g}"
        if kind in _SIGNS:
            return f" {_SIGNS[kind]} ".join(whole)
        constants = [_number(c) for c in instruction.constants]
        if kind == "clamp":
            constants = sorted(set(constants[: len(constants) // 2])) + sorted(set(constants[len(constants) // 2 :]))
        return f"{kind}({', '.join([*whole, *constants[:4]])})"


_PLAIN = ("state", "disturbance", "pick", "join", "constant")


def matrix_of(instruction: Instruction, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Matrix and bias of a ``linear``."""
    rows = len(instruction.constants) // (columns + 1)
    return instruction.constants[: rows * columns].reshape(rows, columns), instruction.constants[rows * columns :]


def _number(value: float) -> str:
    return f"{float(value):.6g}"


def _few(texts: Sequence[str]) -> str:
    return ", ".join([*texts[:6], *(["..."] if len(texts) > 6 else [])])


def _is_sum(text: str) -> bool:
    """Whether a text has a sign outside of brackets."""
    depth = 0
    for before, c in zip(" " + text, text, strict=False):
        depth += (c in "([") - (c in ")]")
        if depth == 0 and c in "+-" and before == " " and text[0] != c:
            return True
    return text.startswith("-")


def _factor(text: str) -> str:
    return f"({text})" if _is_sum(text) or " / " in text and not text.endswith(")") else text


def _times(number: str, text: str) -> str:
    return text if number == "1" else f"-{_factor(text)}" if number == "-1" else f"{number}*{_factor(text)}"


def _sum(parts: list[str], bias: float) -> str:
    if bias or not parts:
        parts = [*parts, _number(bias)]
    text = parts[0]
    for part in parts[1:]:
        text += f" - {part[1:]}" if part.startswith("-") and not _is_sum(part[1:]) else f" + {part}"
    return text


def _pair(kind: str, a: str, b: str) -> str:
    if kind == "add":
        return _sum([a, b], 0.0)
    if kind == "sub":
        return f"{a} - {f'({b})' if _is_sum(b) else b}"
    if kind in _SIGNS:
        return f"{_factor(a)} {_SIGNS[kind]} {f'({b})' if kind == 'div' and (' * ' in b or ' / ' in b) else _factor(b)}"
    return f"{kind}({a}, {b})"
