"""Small mistakes that a module could hold: each is one change of one expression.

A rounding that is left out, a comparison that is strict or not, an index one too far, a sign, the larger for the
smaller. What only speaks to people (complaints, texts, annotations) is left alone.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

SWAPPED_NAMES = {
    "minimum": "maximum",
    "maximum": "minimum",
    "amin": "amax",
    "amax": "amin",
    "min": "max",
    "max": "min",
    "all": "any",
    "any": "all",
    "round_up": "round_down",
    "round_down": "round_up",
}
DROPPED_NAMES = {"UNIT": "0.0", "TINY": "0.0", "SAFETY": "1.0"}
COMPARED = {ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">", ast.Eq: "!=", ast.NotEq: "=="}


@dataclass(frozen=True)
class Mutant:
    """One change of one file.

    Attributes:
        file: relative to the root.
        line: first line of what is changed, from 1.
        kind: ``rounding``, ``comparison``, ``index``, ``sign`` or ``choice``.
        begin, end: what is replaced, as offsets into the text.
        new: what it is replaced by.
        text: the line before.
    """

    file: str
    line: int
    kind: str
    begin: int
    end: int
    new: str
    text: str

    @property
    def key(self) -> str:
        """What names the mutant as long as its line stays as it is, wherever it moves."""
        return hashlib.sha256(f"{self.file}|{self.kind}|{self.text}|{self.new}".encode()).hexdigest()[:16]

    def applied(self, source: str) -> str:
        """The file's text with the change."""
        return source[: self.begin] + self.new + source[self.end :]


def mutants_of(path: Path, file: str) -> Iterator[Mutant]:
    """All mutants of a module."""
    source = path.read_text(encoding="utf-8")
    lines = source.splitlines(keepends=True)
    starts = [0]
    for line in lines:
        starts.append(starts[-1] + len(line))

    def offset(line: int, column: int) -> int:
        return starts[line - 1] + len(lines[line - 1].encode()[:column].decode())

    for node, kind, new in _changes(ast.parse(source)):
        begin, end = offset(node.lineno, node.col_offset), offset(node.end_lineno, node.end_col_offset)
        around = lines[node.lineno - 1].strip() + f" @{node.col_offset}"
        yield Mutant(file, node.lineno, kind, begin, end, new, around)


def _changes(tree: ast.AST) -> Iterator[tuple[ast.expr, str, str]]:
    """Expressions, what kind of mistake, and what is written instead."""
    for node in _computing(tree):
        match node:
            case ast.Name(id=name) if name in DROPPED_NAMES and isinstance(node.ctx, ast.Load):
                yield node, "rounding", DROPPED_NAMES[name]
            case ast.Call(func=ast.Name(id="round_up" | "round_down"), args=[inner]):
                yield node, "rounding", f"({ast.unparse(inner)})"
                yield node.func, "rounding", SWAPPED_NAMES[node.func.id]
            case ast.Call(func=ast.Name(id=name)) if name in SWAPPED_NAMES:
                yield node.func, "choice", SWAPPED_NAMES[name]
            case ast.Call(func=ast.Attribute(attr=name) as called) if name in SWAPPED_NAMES:
                yield called, "choice", f"{_wrapped(called.value)}.{SWAPPED_NAMES[name]}"
            case ast.Compare(ops=[op], left=left, comparators=[right]) if type(op) in COMPARED:
                yield node, "comparison", f"({_wrapped(left)} {COMPARED[type(op)]} {_wrapped(right)})"
            case ast.BinOp(op=ast.Add() | ast.Sub() as op, left=left, right=right):
                if _is_text(left) or _is_text(right):
                    continue
                other = "-" if isinstance(op, ast.Add) else "+"
                yield node, "sign", f"({_wrapped(left)} {other} {_wrapped(right)})"
                if isinstance(right, ast.Constant) and right.value == 1:
                    yield right, "index", "2" if isinstance(op, ast.Add) else "0"
            case ast.UnaryOp(op=ast.USub(), operand=operand) if not isinstance(operand, ast.Constant):
                yield node, "sign", _wrapped(operand)
            case ast.Subscript(slice=slice_):
                for index in _indices(slice_):
                    yield index, "index", str(_number(index) + 1 if _number(index) >= 0 else _number(index) - 1)
            case _:
                pass


def _computing(node: ast.AST) -> Iterator[ast.AST]:
    """Nodes that compute, outermost first: no annotations, decorators, texts, complaints or documentation."""
    skipped = (ast.Raise, ast.Assert, ast.JoinedStr, ast.Import, ast.ImportFrom)
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "bases"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and not isinstance(child, skipped):
                yield child
                yield from _computing(child)


def _indices(node: ast.expr) -> Iterator[ast.expr]:
    """Whole numbers in an index."""
    parts = [node.lower, node.upper] if isinstance(node, ast.Slice) else [node]
    for part in parts:
        if isinstance(part, ast.Tuple):
            for element in part.elts:
                yield from _indices(element)
        elif part is not None and _number(part) is not None:
            yield part


def _number(node: ast.expr) -> int | None:
    try:
        value = ast.literal_eval(node)
    except (ValueError, TypeError):
        return None
    return value if type(value) is int else None


def _is_text(node: ast.expr) -> bool:
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))


def _wrapped(node: ast.expr) -> str:
    return f"({ast.unparse(node)})"
