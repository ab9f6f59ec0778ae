"""JSON of somebody else's file as plain data, at a cost that its length bounds."""

from __future__ import annotations

import json
from typing import Any

LONGEST = 1_000_000
"""Characters; the texts of this project have a few hundred, more where a planner has much to note."""

DEEPEST = 100
"""Levels of lists and mappings."""


class _NestedTooDeep(Exception):
    pass


def _require_shallow(text: str) -> None:
    """The interpreter's own limit is no measure: whoever shares the process may have moved it."""
    if text.count("[") + text.count("{") <= DEEPEST:
        return
    depth, inside, escaped = 0, False, False
    for c in text:
        if inside:
            inside, escaped = escaped or c != '"', c == "\\" and not escaped
        elif c == '"':
            inside, escaped = True, False
        elif c in "[{":
            depth += 1
            if depth > DEEPEST:
                raise _NestedTooDeep
        elif c in "]}":
            depth -= 1


def plain_mapping(text: Any, where: str) -> dict[str, Any]:
    """The mapping that a JSON text holds.

    Args:
        text: what should be one.
        where: its place, for messages.

    Raises:
        ValueError: it is no text, too long, no JSON, nested too deep, no mapping, or has a key twice.
    """
    if not isinstance(text, str) or len(text) > LONGEST:
        raise ValueError(f"{where} must be a text of at most {LONGEST} characters")
    try:
        _require_shallow(text)
        found = json.loads(text, object_pairs_hook=lambda pairs: _mapping(pairs, where))
    except json.JSONDecodeError as e:
        raise ValueError(f"{where} is not JSON: {e}") from None
    except (RecursionError, _NestedTooDeep):
        raise ValueError(f"{where} is nested too deep") from None
    if not isinstance(found, dict):
        raise ValueError(f"{where} must be a mapping, found {type(found).__name__}")
    return found


def _mapping(pairs: list[tuple[str, Any]], where: str) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        twice = next(key for i, (key, _) in enumerate(pairs) if key in dict(pairs[:i]))
        raise ValueError(f"{where} has the key '{twice}' twice")
    return found
