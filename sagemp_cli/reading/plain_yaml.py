"""YAML of somebody else as plain data that can be read in one way only, at a cost that its length bounds."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from sagemp_cli.errors import ArtifactError, ConfigError
from sagemp_cli.reading.regular import require_regular

LONGEST = 100_000
"""Characters; the configs of this project have about 4,000."""
_LARGEST = 1_000_000
DEEPEST = 100
"""Levels of lists and mappings in each other; theirs have about 5."""

_PLAIN = {
    "bool": re.compile(r"true|True|TRUE|false|False|FALSE"),
    "int": re.compile(r"[-+]?(0|[1-9][0-9]*)"),
    "float": re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"),
    "null": re.compile(r"|~|null|Null|NULL"),
    "str": re.compile(r".*", re.DOTALL),
}
"""How a value without quotes may be written, by its type; YAML knows more ways, and not all its readers agree on them:
``010`` is 8, ``1:30`` is 90, ``yes`` is true, ``1_0`` is 10, ``2026-01-01`` is a date."""


class _Plain(yaml.SafeLoader):
    """Plain data with everything written out. Not the loader in C: deep nesting ends the process there."""

    _depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """A node; an alias, by which a short text unfolds to any size, tags and deep nesting are refused."""
        if self.check_event(yaml.AliasEvent):
            raise ValueError(f"line {self.peek_event().start_mark.line + 1} holds an alias")
        event = self.peek_event()
        if getattr(event, "tag", None) is not None:
            raise ValueError(f"line {event.start_mark.line + 1} holds a tag, '{event.tag}'; only plain data is read")
        self._depth += 1
        if self._depth > DEEPEST:
            raise ValueError(f"it is nested more than {DEEPEST} levels deep")
        node = super().compose_node(parent, index)
        self._depth -= 1
        if isinstance(node, yaml.ScalarNode) and node.style is None:
            _require_one_meaning(node)
        if isinstance(node, yaml.MappingNode):
            _require_keys_once(node)
        return node


def _require_one_meaning(node: yaml.ScalarNode) -> None:
    allowed = _PLAIN.get(node.tag.rpartition(":")[2])
    if allowed is None or not allowed.fullmatch(node.value):
        raise ValueError(
            f"line {node.start_mark.line + 1}: {node.value!r} can be read in two ways;"
            " write a number in decimal digits, true or false, or put text in quotes"
        )


def _require_keys_once(node: yaml.MappingNode) -> None:
    seen: set[str] = set()
    for key, _ in node.value:
        if not isinstance(key, yaml.ScalarNode):
            raise ValueError(f"line {key.start_mark.line + 1}: a key must be a text or a number")
        if key.value in seen:
            raise ValueError(f"line {key.start_mark.line + 1}: the key '{key.value}' is there twice")
        seen.add(key.value)


def plain_yaml(text: str) -> Any:
    """What a text says, if that can be read in one way only.

    Raises:
        ValueError: it is too long or too deep, holds an alias, a tag or a key twice, or a value without quotes that
            not all readers of YAML take for the same.
        yaml.YAMLError: it is no YAML.
    """
    if len(text) > LONGEST:
        raise ValueError(f"it has {len(text)} characters, more than {LONGEST}")
    return yaml.load(text, Loader=_Plain)


def yaml_in(path: Path, what: str) -> Any:
    """What a file says, see :func:`plain_yaml`; None of an empty one.

    Args:
        path: the file.
        what: what it is, for messages.

    Raises:
        ConfigError: one line: it is missing, no regular file, too large, or no such YAML.
    """
    try:
        if require_regular(path, "a file in YAML") > _LARGEST:
            raise ConfigError(f"{what}: is larger than {_LARGEST} bytes")
        return plain_yaml(path.read_text(encoding="utf-8"))
    except ArtifactError as e:
        raise ConfigError(f"{what}: {str(e).removeprefix(f'{path}: ')}") from None
    except OSError as e:
        raise ConfigError(f"{what}: cannot be read ({e.strerror})") from None
    except (yaml.YAMLError, UnicodeDecodeError) as e:
        raise ConfigError(f"{what}: not readable as YAML ({_said(e)})") from None
    except ValueError as e:
        raise ConfigError(f"{what}: {e}") from None


def _said(error: Exception) -> str:
    """What is wrong, and in which line."""
    mark = getattr(error, "problem_mark", None)
    if mark is None:
        return " ".join(str(error).split())
    return f"line {mark.line + 1}: {' '.join(str(getattr(error, 'problem', error)).split())}"
