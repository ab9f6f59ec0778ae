"""Configuration: Hydra's compose API in one function.

A config is plain data: the stages hand its values as arguments to what they build, and no config enters a
class. How sections become objects is in :mod:`sagemp_cli.config.binding`.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeGuard, cast

from sagemp_cli.config.folders import (
    config_file,
    config_folders,
    first_line,
    is_file,
    load_scene,
    mapping_in,
    resource_folder,
)
from sagemp_cli.config.inherited import set_back_options_of_others
from sagemp_cli.errors import ConfigError, did_you_mean
from sagemp_cli.plugins import KINDS
from sagemp_cli.plugins.project import current_project
from sagemp_cli.plugins.registry import from_outside

_ROOT = "sagemp"
"""The file that everything begins with; a project's own ``conf/`` has other files, and usually no such one."""


def groups() -> list[str]:
    """Names of the config groups, e.g. ``planner``."""
    every = (p for folder in config_folders() for p in folder.iterdir())
    return sorted({p.name for p in every if p.is_dir() and any(p.glob("*.yaml"))})


def options_of(group: str) -> list[str]:
    """Names of the options of a config group, e.g. all experiments; plugins are options too.

    A file whose name begins with an underscore is what others have in common, and no option.
    """
    files = {p.stem for folder in config_folders() for p in (folder / group).glob("*.yaml")}
    return sorted({name for name in files if not name.startswith("_")} | set(_plugins(group)))


DEEPEST = 100
"""Levels of lists and mappings in one override."""


def _depth(text: str) -> int:
    depth = most = 0
    for c in text:
        depth += (c in "[{") - (c in "]}")
        most = max(most, depth)
    return most


def compose(overrides: Sequence[str] = ()) -> dict[str, Any]:
    """The resolved config as plain data, with the scene's file read in.

    One number given for a list of numbers stands for as many of them as the list has:
    ``planner.hidden=64`` makes every hidden layer 64 wide. Options that an experiment sets for the planner (or tracker,
    ...) that it picks are for that one: where another one is picked they do not count.

    The plugins of the project in the working directory are loaded first.

    Args:
        overrides: Hydra overrides ``key=value``; ``group=option`` picks an option of a config group, an
            ``experiment`` may be the path of a file.

    Raises:
        ConfigError: one line that names the override or key, with the nearest known name.
    """
    if any(_depth(text) > DEEPEST for text in overrides):  # whoever shares the process may have moved Python's limit
        raise ConfigError("config: an override is nested too deep")
    try:
        return _checked(overrides)
    except RecursionError:  # of a file
        raise ConfigError("config: an override is nested too deep") from None


def _checked(overrides: Sequence[str]) -> dict[str, Any]:
    parsed = [_parse(text) for text in overrides]
    choices = tuple(_chosen(o) for o in parsed if _is_group(o.key_or_group))
    values = [o for o in parsed if not _is_group(o.key_or_group)]
    before = _leaves_of(choices, _surroundings()) if values else {}
    for override in values:
        _check_override(override, before)
    config = _composed([*choices, *(o.input_line for o in values)])
    for override in values:
        listed, given = before.get(override.key_or_group), override.value()
        if _is_numbers(listed) and _is_number(given):
            _put(config, override.key_or_group, [given] * len(listed))
    picked = {o.key_or_group: str(o.value()) for o in parsed if _is_group(o.key_or_group)}
    set_back_options_of_others(config, picked, [o.key_or_group for o in values], alone=_alone)
    config["scene"] = load_scene(config["scene"])
    return config


def chosen_options(overrides: Sequence[str] = ()) -> dict[str, str]:
    """Which option of each config group is in use."""
    parsed = [_parse(text) for text in overrides]
    lines = [_chosen(o) if _is_group(o.key_or_group) else o.input_line for o in parsed]
    return dict(_hydra(lines, with_hydra=True).hydra.runtime.choices)


def known_keys(overrides: Sequence[str] = ()) -> Mapping[str, Any]:
    """All dotted keys, with their values, of the config that picks the same options and overrides nothing."""
    parsed = [_parse(text) for text in overrides]
    choices = tuple(_chosen(o) for o in parsed if _is_group(o.key_or_group))
    return _leaves_of(choices, _surroundings())


def _plugins(group: str) -> list[str]:
    """Options that are plugins, which need no config file of their own; those of the project are loaded first."""
    current_project().load_plugins()
    return from_outside(group) if group in KINDS else []


def _chosen(override: Any) -> str:
    """A group choice as Hydra gets it; the file of an experiment, and a plugin without one, are made known to it."""
    from hydra.core.config_store import ConfigStore
    from omegaconf.errors import OmegaConfBaseException

    group, option = override.key_or_group, override.value()
    if group == "experiment" and is_file(option):
        path, option = option, re.sub(r"\W", "_", f"_{option}")
        node = _experiment(path)
        try:
            ConfigStore.instance().store(group=group, name=option, node=node, package="_global_")
        except OmegaConfBaseException as e:
            raise ConfigError(f"experiment file {path}: {first_line(e)}") from None
        return f"{group}={option}"
    return str(override.input_line)


def _store_plugins() -> None:
    """Make plugins that have no config file known to Hydra as options of their groups."""
    from hydra.core.config_store import ConfigStore

    for group in KINDS:
        for name in (name for name in _plugins(group) if config_file(group, name) is None):
            ConfigStore.instance().store(group=group, name=name, node={"name": name})


@functools.cache
def _search_project_first() -> None:
    """Make Hydra look into the project's own config folder before the package's, and read it strictly."""
    from hydra.core.config_search_path import ConfigSearchPath
    from hydra.core.plugins import Plugins
    from hydra.plugins.search_path_plugin import SearchPathPlugin

    from sagemp_cli.config.strict_source import SCHEME, StrictSource

    class ProjectFirst(SearchPathPlugin):
        def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
            for folder in reversed(config_folders()[:-1]):
                search_path.prepend(provider="project", path=f"{SCHEME}://{folder}")

    Plugins.instance().register(ProjectFirst)
    Plugins.instance().register(StrictSource)


def _experiment(path: str) -> dict[str, Any]:
    """The content of an experiment's file."""
    data = mapping_in(Path(path), f"experiment file {path}")
    return {"name": Path(path).stem} | data


def _alone(group: str, option: str) -> Mapping[str, Any]:
    """What an option's file says by itself."""
    from omegaconf import OmegaConf

    found = OmegaConf.to_container(_hydra([], name=f"{group}/{option}"), resolve=False)
    assert isinstance(found, dict)
    return cast("dict[str, Any]", found)


def _composed(overrides: Sequence[str]) -> dict[str, Any]:
    """What Hydra makes of the overrides, as plain data."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    try:
        config = OmegaConf.to_container(_hydra(overrides), resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as e:
        raise ConfigError(f"config: {first_line(e)}") from None
    assert isinstance(config, dict)
    return cast("dict[str, Any]", config)


def _hydra(overrides: Sequence[str], *, with_hydra: bool = False, name: str = _ROOT) -> Any:
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    said = list(overrides)
    if name == _ROOT:
        picked = current_project().experiment
        if picked is not None and not any(o.startswith("experiment=") for o in said):
            said.insert(0, f"experiment={picked}")
    _search_project_first()
    _store_plugins()
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(config_dir=str(resource_folder("conf")), version_base="1.3"):
            return hydra_compose(config_name=name, overrides=said, return_hydra_config=with_hydra)
    except (HydraException, OmegaConfBaseException) as e:
        raise ConfigError(f"config: {first_line(e)}") from None


def _parse(text: str) -> Any:
    """One override, parsed; group choices are checked here."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        override = OverridesParser.create().parse_override(text)
    except HydraException as e:
        raise ConfigError(f"'{text}' is not an override of the form key=value: {first_line(e)}") from None
    if override.is_sweep_override():
        raise ConfigError(f"{text}: sweeps are not supported; give one value (lists are written [1,2])")
    if override.is_delete():
        raise ConfigError(f"{text}: keys cannot be removed; set another value")
    group = override.key_or_group
    if _is_group(group):
        choice, known = override.value(), options_of(group)
        if group == "experiment" and is_file(choice):
            if not Path(choice).is_file():
                raise ConfigError(f"experiment={choice}: no such file; known experiments: {', '.join(known)}")
        elif choice not in known:
            near = did_you_mean(str(choice), known)
            raise ConfigError(f"{group}={choice}: unknown {group}{near}; known: {', '.join(known)}")
    return override


def _check_override(override: Any, before: Mapping[str, Any]) -> None:
    """Complain about an unknown key, or one value where a section is."""
    key, new = override.key_or_group, override.value()
    if override.is_add() or override.is_force_add():
        return
    if key not in before:
        top = sorted({k.partition(".")[0] for k in before})
        near = did_you_mean(key, before)
        raise ConfigError(f"{key}: unknown key{near}" + ("" if near else f"; known at the top: {', '.join(top)}"))
    if isinstance(before[key], dict) and not isinstance(new, dict | None) and key != "scene":
        raise ConfigError(f"{key} is a section, found {new!r}; its keys: {', '.join(before[key])}")


def _is_group(key: str) -> bool:
    return any((folder / key).is_dir() for folder in config_folders())


def _surroundings() -> tuple[Any, ...]:
    """What the composition depends on beside the overrides: the project, its files and the plugins."""
    own = current_project()
    files = () if own.conf is None else tuple((str(p), p.stat().st_mtime_ns) for p in sorted(own.conf.rglob("*.yaml")))
    return (own, files, tuple((group, *_plugins(group)) for group in KINDS))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_numbers(value: Any) -> TypeGuard[list[Any]]:
    return isinstance(value, list) and bool(value) and all(_is_number(v) for v in value)


@functools.cache
def _leaves_of(choices: tuple[str, ...], surroundings: tuple[Any, ...]) -> Mapping[str, Any]:
    """All dotted keys, with their values, of the config that picks these options and overrides nothing."""
    return dict(_leaves(_composed(choices)))


def _leaves(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """All dotted keys with their values, sections included."""
    for key, value in node.items():
        yield f"{prefix}{key}", value
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")


def _put(config: dict[str, Any], dotted: str, value: Any) -> None:
    *path, last = dotted.split(".")
    for part in path:
        config = config[part]
    config[last] = value
