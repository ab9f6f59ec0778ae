"""YAML of somebody else's file as plain data, at a cost that its length bounds."""

from __future__ import annotations

from typing import Any

import yaml

LONGEST = 100_000
"""Characters; the configs of this project have about 4,000."""
DEEPEST = 100
"""Levels of lists and mappings in each other; theirs have about 5."""


class _Plain(yaml.SafeLoader):
    """Plain data with everything written out. Not the loader in C: deep nesting ends the process there."""

    _depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """A node; an alias, by which a short text unfolds to any size, and deep nesting are refused."""
        if self.check_event(yaml.AliasEvent):
            raise ValueError("its config holds an alias")
        self._depth += 1
        if self._depth > DEEPEST:
            raise ValueError(f"its config is nested more than {DEEPEST} levels deep")
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node


def plain_yaml(text: str) -> Any:
    """What a config says, without aliases.

    Raises:
        ValueError: it is too long or too deep, or holds an alias.
        yaml.YAMLError: it is no YAML, or holds more than plain data.
    """
    if len(text) > LONGEST:
        raise ValueError(f"its config has {len(text)} characters, more than {LONGEST}")
    return yaml.load(text, Loader=_Plain)
