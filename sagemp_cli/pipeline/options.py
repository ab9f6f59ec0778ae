"""Complaints about the sections that the stages read key by key; each is one line that names the key."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sagemp_cli.errors import did_you_mean


def without(section: Mapping[str, Any], *keys: str) -> dict[str, Any]:
    """The section's other keys."""
    return {key: value for key, value in section.items() if key not in keys}


def key_complaints(section: Mapping[str, Any], where: str, known: Sequence[str]) -> list[str]:
    """Keys of a section that nobody reads."""
    unknown = [str(key) for key in section if key not in known]
    near = [did_you_mean(key, known) or f"; known: {', '.join(known)}" for key in unknown]
    return [f"{where}.{key}: no such option{hint}" for key, hint in zip(unknown, near, strict=True)]


def number_complaints(section: Mapping[str, Any], where: str, **least: int) -> list[str]:
    """Keys of a section that are not whole numbers of at least what is said of each."""
    return [
        f"{where}.{key} must be a whole number of at least {bound}, found {section.get(key)!r}"
        for key, bound in least.items()
        if not is_whole(section.get(key), bound)
    ]


def is_whole(value: Any, least: int) -> bool:
    """Whether a value is a whole number of at least so much."""
    return isinstance(value, int) and not isinstance(value, bool) and value >= least
