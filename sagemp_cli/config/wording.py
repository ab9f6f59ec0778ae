"""What a type hint allows, in words: "a whole number of at least 1", "a list of numbers or null"."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from annotated_types import DocInfo, Ge, Gt, Interval, Le, Lt, MinLen

_PLURAL = {
    "a whole number": "whole numbers",
    "a number": "numbers",
    "a positive number": "positive numbers",
    "a text": "texts",
    "true or false": "true or false",
}


def described(hint: Any) -> str:
    """What a value of this type is, in a few words; "anything" if the hint does not say."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        said = [m.documentation for m in inner[1:] if isinstance(m, DocInfo)]
        return said[-1] if said else _bounded(inner[0], inner[1:])
    if origin in (Union, UnionType):
        words = [described(h) for h in inner if h is not type(None)]
        return " or ".join(words + ["null"] * (type(None) in inner))
    if origin is Literal:
        return "one of " + ", ".join(str(value) for value in inner)
    if origin in (list, tuple, Sequence):
        return f"a list of {_plural(described(inner[0] if inner else Any))}"
    if origin is Mapping or origin is dict or hint is dict or is_dataclass(hint):
        return "a section"
    return {int: "a whole number", float: "a number", str: "a text", bool: "true or false"}.get(hint, "anything")


def _bounded(hint: Any, metadata: Sequence[Any]) -> str:
    low = high = None
    open_low = open_high = False
    for m in metadata:
        parts = list(m) if isinstance(m, Interval) else [m]
        for part in parts:
            if isinstance(part, Ge | Gt):
                low, open_low = part.ge if isinstance(part, Ge) else part.gt, isinstance(part, Gt)
            if isinstance(part, Le | Lt):
                high, open_high = part.le if isinstance(part, Le) else part.lt, isinstance(part, Lt)
    words = described(hint)
    if low is not None and high is not None:
        return f"{words} in {'(' if open_low else '['}{low}, {high}{')' if open_high else ']'}"
    if low is not None:
        if open_low:
            return words.replace("a ", "a positive ", 1) if low == 0 else f"{words} above {low}"
        return f"{words} of at least {low}"
    if high is not None:
        return f"{words} {'below' if open_high else 'of at most'} {high}"
    some = any(isinstance(m, MinLen) and m.min_length > 0 for m in metadata)
    return words.replace("a list", "a non-empty list", 1) if some else words


def _plural(words: str) -> str:
    """Words for several of what is described."""
    for one, many in _PLURAL.items():
        if words == one or words.startswith(f"{one} "):
            return many + words.removeprefix(one)
    return words
