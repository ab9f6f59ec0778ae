"""Objects from config sections, by allow-listed class names and checked signatures.

A section is ``_target_`` and keyword arguments. The resolved config is stored in every artifact, and a later
stage builds from the artifact's own config, so a section is untrusted input: ``_target_`` may only name a class
that is defined in one of :data:`ALLOWED_PACKAGES`.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from sagemp_cli.errors import ConfigError, did_you_mean

ALLOWED_PACKAGES = ("dynamics", "loop", "planners", "reachability", "verification", "experts")
"""Subpackages of sagemp_cli whose classes a config may name as ``_target_``."""

FROM_DATA = ("state_dim", "state_names", "control_dim", "horizon", "dt")
"""Arguments that the stages take from the robot and the horizon; a config need not give them."""

_PACKAGE = Path(__file__).resolve().parents[1]


def target_class(section: Mapping[str, Any], where: str) -> type:
    """The class that a section's ``_target_`` names, if the allow-list permits it."""
    target = section.get("_target_")
    if not isinstance(target, str):
        raise ConfigError(f"{where}._target_ must name a class, found {target!r}")
    parts = target.split(".")
    plain = all(part.isidentifier() for part in parts)
    if not plain or len(parts) < 3 or parts[0] != "sagemp_cli" or parts[1] not in ALLOWED_PACKAGES:
        allowed = ", ".join(f"sagemp_cli.{p}" for p in ALLOWED_PACKAGES)
        raise ConfigError(f"{where}._target_ '{target}' is not allowed; targets must be classes of {allowed}")
    module_name, name = ".".join(parts[:-1]), parts[-1]
    source = _PACKAGE.joinpath(*parts[1:-1])
    if not (source.with_suffix(".py").is_file() or (source / "__init__.py").is_file()):
        raise ConfigError(f"{where}._target_ '{target}': there is no module {module_name}")
    found = getattr(importlib.import_module(module_name), name, None)
    if not inspect.isclass(found) or found.__module__ != module_name:
        raise ConfigError(f"{where}._target_ '{target}': {module_name} defines no class {name}")
    return found


def complaints(section: Mapping[str, Any], where: str, **extra: Any) -> list[str]:
    """Everything that is wrong with a section: its target, unknown and missing options, values of the wrong type.

    Args:
        section: ``_target_`` and keyword arguments.
        where: name of the section in messages.
        extra: further keyword arguments that come from data, not from the config.
    """
    try:
        cls = target_class(section, where)
    except ConfigError as e:
        return [str(e)]
    return option_complaints(cls, {k: v for k, v in section.items() if k != "_target_"}, where, given=extra)


def option_complaints(
    function: Callable[..., Any], options: Any, where: str, *, given: Collection[str] = ()
) -> list[str]:
    """Everything that is wrong with options as keyword arguments of a function or class.

    Args:
        function: what takes the options.
        options: mapping of the config; None stands for no options.
        where: name of the section in messages.
        given: arguments that are given otherwise, which the options may not set.
    """
    options = {} if options is None else options
    if not isinstance(options, Mapping):
        return [f"{where} must be a mapping, found {options!r}"]
    parameters = parameters_of(function)
    allowed = [k for k in parameters if k not in given]
    found = []
    for key, value in options.items():
        if key not in allowed:
            near = did_you_mean(str(key), allowed) or f"; known: {', '.join(allowed) or 'none'}"
            found.append(f"{where}.{key}: {function.__name__} has no such option{near}")
        elif not _fits(value, _hint(*parameters[key])):
            found.append(f"{where}.{key} must be {parameters[key][0].annotation}, found {value!r}")
    missing = [k for k in allowed if parameters[k][0].default is inspect.Parameter.empty and k not in options]
    if missing:
        found.append(f"{where}: {function.__name__} needs {', '.join(missing)}")
    return found


def parameters_of(function: Callable[..., Any]) -> dict[str, tuple[inspect.Parameter, Callable[..., Any]]]:
    """The parameters of a function or of a class's constructor by name, each with the function that declares it.

    A constructor that takes ``**others`` hands them to its base class, so those of the base class are parameters too.
    """
    if not inspect.isclass(function):
        return {name: (p, function) for name, p in inspect.signature(function).parameters.items()}
    found: dict[str, tuple[inspect.Parameter, Callable[..., Any]]] = {}
    for constructor in (cls.__init__ for cls in function.__mro__[:-1] if "__init__" in vars(cls)):
        _, *own = inspect.signature(constructor).parameters.values()
        named = {p.name: (p, constructor) for p in own if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)}
        found = named | found
        if not any(p.kind is p.VAR_KEYWORD for p in own):
            break
    return found


def options_for(
    function: Callable[..., Any], options: Any, where: str, *, given: Collection[str] = ()
) -> dict[str, Any]:
    """Options as keyword arguments of a function or class that takes them all: none is silently ignored.

    Raises:
        ConfigError: one line with all :func:`option_complaints`, whose arguments these are.
    """
    wrong = option_complaints(function, options, where, given=given)
    if wrong:
        raise ConfigError("; ".join(wrong))
    return dict(options or {})


def all_complaints(config: Mapping[str, Any]) -> list[str]:
    """The complaints about every section of a config that names a class."""
    return [
        complaint
        for name, section in config.items()
        if isinstance(section, Mapping) and "_target_" in section
        for complaint in complaints(section, name)
        if not _only_from_data(complaint)
    ]


def _only_from_data(complaint: str) -> bool:
    _, needs, names = complaint.partition(" needs ")
    return bool(needs) and set(names.split(", ")) <= set(FROM_DATA)


def _hint(parameter: inspect.Parameter, declared: Callable[..., Any]) -> Any:
    """The type that a parameter's annotation names; Any if it is a name that exists for type checkers only."""
    holder = SimpleNamespace(__annotations__={"it": parameter.annotation})
    try:
        return get_type_hints(holder, globalns=getattr(declared, "__globals__", {}))["it"]
    except NameError:
        return Any


def _fits(value: Any, hint: Any) -> bool:
    """Whether plain config data fits a type hint; hints of other things than plain data fit everything."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return any(_fits(value, h) for h in inner)
    if origin in (list, tuple, Sequence):
        items = inner[:1] or (Any,)
        return isinstance(value, list | tuple) and all(_fits(v, items[0]) for v in value)
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if hint in (bool, str, type(None)):
        return isinstance(value, hint)
    return True


def build(section: Mapping[str, Any], where: str, **extra: Any) -> Any:
    """Build the object that a config section describes.

    Args:
        section: ``_target_`` and keyword arguments.
        where: name of the section in messages.
        extra: further keyword arguments that come from data, not from the config.
    """
    cls = target_class(section, where)
    options = options_for(cls, {k: v for k, v in section.items() if k != "_target_"}, where, given=extra)
    try:
        return cls(**options, **extra)
    except (TypeError, ValueError) as e:
        first = next((line for line in str(e).splitlines() if line.strip()), type(e).__name__)
        raise ConfigError(f"{where}: {first.strip()}") from e
