"""Config sections as keyword arguments of functions, checked before anything is computed."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

from sagemp_cli.errors import ConfigError, did_you_mean


def options_for(
    function: Callable[..., Any], section: Any, where: str, *, given: tuple[str, ...] = ()
) -> dict[str, Any]:
    """The section's entries if ``function`` takes them all; an option is never silently ignored.

    Args:
        function: a function or class with keyword arguments.
        section: mapping of the config, or None for no options.
        where: name of the section in messages.
        given: arguments that the stage passes itself, which the section may not set.

    Raises:
        ConfigError: an unknown or reserved option (with the nearest known one), or a missing one.
    """
    options = {} if section is None else section
    if not isinstance(options, Mapping):
        raise ConfigError(f"{where} must be a mapping, found {options!r}")
    parameters = inspect.signature(function).parameters
    allowed = [k for k in parameters if k not in given]
    for key in options:
        if key not in allowed:
            raise ConfigError(f"{where}.{key}: no such option{did_you_mean(key, allowed)}; known: {', '.join(allowed)}")
    missing = [k for k in allowed if parameters[k].default is inspect.Parameter.empty and k not in options]
    if missing:
        raise ConfigError(f"{where} needs {', '.join(missing)}")
    return dict(options)


def whole_number(value: Any, where: str, *, least: int = 1) -> int:
    """``value`` if it is a whole number of at least ``least``."""
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise ConfigError(f"{where} must be a whole number of at least {least}, found {value!r}")
    return value
