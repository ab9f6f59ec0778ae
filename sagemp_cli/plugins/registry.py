"""The one table of names: what configs and artifacts call a robot or planner, and what stands behind the name.

A name is looked up among what comes with the package, what plugins of this run have registered, and what installed
packages declare as entry points (``sagemp.robots``, ``sagemp.planners``, ...). A config of an artifact is untrusted
input: it can only pick a name that is known here, never a module.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import metadata
from typing import Any, TypeVar

from sagemp_cli.errors import ConfigError, did_you_mean
from sagemp_cli.plugins.project import current_project

Thing = TypeVar("Thing", bound=Callable[..., Any])


@dataclass(frozen=True)
class Kind:
    """One kind of thing that a config section picks by name.

    Attributes:
        section: the section of the config.
        group: entry points of installed packages are in ``sagemp.<group>``.
        noun: what one is called in messages.
        built_in: ``module:class`` by name, of what comes with the package; imported when it is asked for.
        from_data: arguments that the stages give from the robot and the horizon; no config sets them.
        called_with: arguments that a plain function gets each time it is called; no config sets them.
        said: class attributes of what is built in, by attribute and name, which the graph of stages asks for: torch
            need not be imported to know them.
    """

    section: str
    group: str
    noun: str
    built_in: Mapping[str, str]
    from_data: tuple[str, ...] = ()
    called_with: tuple[str, ...] = ()
    said: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


_DATA = ("state_dim", "state_names", "control_dim", "horizon", "dt", "robot")

KINDS: Mapping[str, Kind] = {
    kind.section: kind
    for kind in (
        Kind(
            "dynamics",
            "robots",
            "robot",
            {
                "kinematic_unicycle": "sagemp_cli.dynamics.kinematic_unicycle:KinematicUnicycle",
                "learned": "sagemp_cli.dynamics.learned:Learned",
                "planar_quadrotor": "sagemp_cli.dynamics.planar_quadrotor:PlanarQuadrotor",
                "quadrotor": "sagemp_cli.dynamics.quadrotor:Quadrotor",
                "unicycle": "sagemp_cli.dynamics.unicycle:Unicycle",
            },
        ),
        Kind(
            "planner",
            "planners",
            "planner",
            {
                "diffusion": "sagemp_cli.planners.diffusion:Diffusion",
                "flow_matching": "sagemp_cli.planners.flow_matching:FlowMatching",
                "from_file": "sagemp_cli.planners.from_file:FromFile",
                "neural_ode": "sagemp_cli.planners.neural_ode:NeuralODE",
                "vlm": "sagemp_cli.planners.vlm.planner:VLM",
            },
            from_data=_DATA,
            called_with=("start", "goal", "scene", "count", "generator"),
            said={
                "learns_from": {
                    "diffusion": "demonstrations",
                    "flow_matching": "demonstrations",
                    "from_file": "nothing",
                    "neural_ode": "demonstrations",
                    "vlm": "scenes",
                }
            },
        ),
        Kind(
            "tracker",
            "trackers",
            "tracker",
            {"mlp": "sagemp_cli.loop.tracker:Tracker", "onnx": "sagemp_cli.loop.onnx_format.tracker:OnnxTracker"},
            from_data=_DATA,
            said={"trains": {"mlp": True, "onnx": False}},
        ),
        Kind(
            "propagator",
            "propagators",
            "propagator",
            {
                "affine": "sagemp_cli.reachability.affine.affine:Affine",
                "auto_lirpa": "sagemp_cli.reachability.lirpa.auto_lirpa:AutoLirpa",
                "best": "sagemp_cli.reachability.crown.best:Best",
                "crown": "sagemp_cli.reachability.crown.crown:Crown",
                "interval": "sagemp_cli.reachability.interval.interval:Interval",
            },
        ),
        Kind(
            "executor",
            "executors",
            "executor",
            {
                "dask": "sagemp_cli.verification.executors.cluster:Dask",
                "processes": "sagemp_cli.verification.executors.processes:Processes",
                "serial": "sagemp_cli.verification.executors.serial:Serial",
            },
        ),
    )
}
"""By the section of the config that picks one."""

_registered: dict[tuple[str, str], Callable[..., Any]] = {}
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


def register(section: str, name: str, thing: Callable[..., Any]) -> None:
    """Make a class, or of a planner a plain function, known under a name.

    Raises:
        ConfigError: the name is none, or it belongs to something else.
    """
    kind = KINDS[section]
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ConfigError(f"a {kind.noun}'s name must be letters, digits and underscores, found {name!r}")
    there = _registered.get((section, name))
    again = there is not None and (there.__module__, there.__qualname__) == (thing.__module__, thing.__qualname__)
    if name in kind.built_in or (there is not None and not again):
        owner = "this package" if there is None else there.__module__
        raise ConfigError(f"{kind.noun} '{name}' of {thing.__module__}: the name is taken by {owner}; pick another")
    _registered[section, name] = thing


def _door(section: str) -> Callable[[str], Callable[[Thing], Thing]]:
    def named(name: str) -> Callable[[Thing], Thing]:
        def keep(thing: Thing) -> Thing:
            register(section, name, thing)
            return thing

        return keep

    named.__doc__ = f"Register what is decorated as a {KINDS[section].noun} of this name."
    return named


robot = _door("dynamics")
planner = _door("planner")
tracker = _door("tracker")
propagator = _door("propagator")
executor = _door("executor")


def from_outside(section: str) -> list[str]:
    """Names of one kind that do not come with the package."""
    registered = (name for where, name in _registered if where == section)
    return sorted({*registered, *(e.name for e in metadata.entry_points(group=f"sagemp.{KINDS[section].group}"))})


def names(section: str) -> list[str]:
    """All known names of one kind."""
    return sorted({*KINDS[section].built_in, *from_outside(section)})


def resolve(section: str, name: Any, where: str) -> Callable[..., Any]:
    """What stands behind a name.

    Args:
        section: which kind, a key of :data:`KINDS`.
        name: as a config has it.
        where: the config section in messages.

    Raises:
        ConfigError: no such name; or the package that declares it does not load.
    """
    kind = KINDS[section]
    if isinstance(name, str):
        if name in kind.built_in:
            module, _, attribute = kind.built_in[name].partition(":")
            return getattr(importlib.import_module(module), attribute)
        if (section, name) in _registered:
            return _registered[section, name]
        for entry in metadata.entry_points(group=f"sagemp.{kind.group}", name=name):
            return _loaded(entry, kind)
        current_project().load_plugins()  # what the person at the keyboard has named, whatever the name is
        if (section, name) in _registered:
            return _registered[section, name]
    known = names(section)
    near = did_you_mean(str(name), known) if isinstance(name, str) else ""
    raise ConfigError(
        f"{where}.name {name!r}: no such {kind.noun}{near}; known: {', '.join(known)}; "
        f"name the file that brings your own with --plugin FILE.py, or in conf/project.yaml"
    )


def declared(section: str, name: Any, where: str, attribute: str, default: Any) -> Any:
    """A class attribute of what stands behind a name; of what comes with the package without importing it.

    Args:
        section, name, where: as of :func:`resolve`.
        attribute: one that the kind says, see :attr:`Kind.said`.
        default: of a plugin that does not have it.
    """
    said = KINDS[section].said[attribute]
    if isinstance(name, str) and name in said:
        return said[name]
    return getattr(resolve(section, name, where), attribute, default)


def _loaded(entry: metadata.EntryPoint, kind: Kind) -> Callable[..., Any]:
    try:
        thing = entry.load()
    except Exception as e:
        raise ConfigError(
            f"{kind.noun} '{entry.name}' of an installed package ({entry.value}) does not load: {type(e).__name__}: {e}"
        ) from e
    if not callable(thing):
        raise ConfigError(f"{kind.noun} '{entry.name}' ({entry.value}) is {thing!r}; a class is needed")
    return thing
