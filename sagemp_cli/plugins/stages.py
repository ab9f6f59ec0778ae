"""Stages from outside: what a plugin registers as a step of the pipeline, next to those that come with the package."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import metadata
from typing import Any, TypeVar

from sagemp_cli.errors import ConfigError
from sagemp_cli.plugins.project import current_project

Function = TypeVar("Function", bound=Callable[..., Any])

GROUP = "sagemp.stages"
"""Entry points of installed packages."""

_TAKEN = """
    artifacts build-library certificate check config demonstrations disturbance doctor dynamics dynamics-training effort
    execute executor experiment expert export gen-data horizon init inspect library name planner planner-training proof
    propagator prove recheck rollouts run safety safety-rates scene seed sources start status toy tracker
    tracker-training train-dynamics train-planner train-tracker verify
"""
TAKEN = frozenset(_TAKEN.split())
"""Commands, sections of the config and kinds of file of the package; a stage is all three under one name."""


@dataclass(frozen=True)
class OwnStage:
    """A stage from outside: a command, a file and a section of the config, all of one name.

    Attributes:
        name: the command; the file is ``<name>.h5``, its options are the config's section ``<name>`` (``-`` as ``_``).
        function: ``function(context, inputs, **options) -> record``; ``inputs`` are artifacts by stage, options its
            keyword arguments.
        record: class of what it gives, declared as those in :mod:`sagemp_cli.storage.kinds`.
        inputs: stages whose files it reads.
        sections: dotted config keys that its output depends on, beyond those of its inputs.
    """

    name: str
    function: Callable[..., Any]
    record: type
    inputs: tuple[str, ...]
    sections: tuple[str, ...]

    @property
    def section(self) -> str:
        """Key of its options in the config."""
        return self.name.replace("-", "_")


_registered: dict[str, OwnStage] = {}
_NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")


def stage(
    name: str, *, record: type, inputs: Sequence[str] = (), sections: Sequence[str] = ()
) -> Callable[[Function], Function]:
    """Register what is decorated as a stage, see :class:`OwnStage`; stages that it reads are registered before it.

    Raises:
        ConfigError: the name is none, or it belongs to something else.
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ConfigError(f"a stage's name must be small letters, digits and hyphens, found {name!r}")
    if name in TAKEN:
        raise ConfigError(f"stage '{name}': the name is taken by this package; pick another")

    def keep(function: Function) -> Function:
        there = _registered.get(name)
        if there is not None and _place(there.function) != _place(function):
            raise ConfigError(f"stage '{name}': the name is taken by {there.function.__module__}; pick another")
        _registered[name] = OwnStage(name, function, record, tuple(inputs), tuple(sections))
        return function

    return keep


def own_stages() -> tuple[OwnStage, ...]:
    """All stages from outside, in the order in which they were registered: of this run's plugins, of the project in the
    working directory and of installed packages.

    Raises:
        ConfigError: a plugin or package that declares one does not load.
    """
    current_project().load_plugins()
    for entry in metadata.entry_points(group=GROUP):
        if entry.name in _registered:
            continue
        try:
            entry.load()
        except Exception as e:
            raise ConfigError(
                f"stage '{entry.name}' of an installed package ({entry.value}) does not load: {type(e).__name__}: {e}"
            ) from e
        if entry.name not in _registered:
            raise ConfigError(f"stage '{entry.name}' of an installed package ({entry.value}): registers no such stage")
    return tuple(_registered.values())


def _place(function: Callable[..., Any]) -> tuple[str, str]:
    return function.__module__, function.__qualname__
