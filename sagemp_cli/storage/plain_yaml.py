"""YAML of somebody else's file as plain data, at a cost that its length bounds."""

from __future__ import annotations

from typing import Any

import yaml

LONGEST = 100_000
"""Characters; the configs of this project have about 4,000."""


class _Plain(yaml.SafeLoader):
    """Plain data with everything written out. Not the loader in C: deep nesting ends the process there."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        """A node; an alias, by which a short text unfolds to any size, is refused."""
        if self.check_event(yaml.AliasEvent):
            raise ValueError("its config holds an alias")
        return super().compose_node(parent, index)


def plain_yaml(text: str) -> Any:
    """What a config says, without aliases.

    Raises:
        ValueError: it is too long, or holds an alias.
        yaml.YAMLError: it is no YAML, or holds more than plain data.
        RecursionError: it is nested too deeply.
    """
    if len(text) > LONGEST:
        raise ValueError(f"its config has {len(text)} characters, more than {LONGEST}")
    return yaml.load(text, Loader=_Plain)
