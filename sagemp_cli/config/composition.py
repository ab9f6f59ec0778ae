"""Configuration: Hydra's compose API in one function.

A config is plain data: the stages hand its values as arguments to what they build, and no config enters a
class. How sections become objects is in :mod:`sagemp_cli.config.binding`.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from sagemp_cli.errors import ConfigError, did_you_mean

_PACKAGE = Path(__file__).resolve().parents[1]


def resource_folder(name: str) -> Path:
    """The folder ``conf`` or ``data``: inside the installed package, or at the top of a checkout."""
    inside = _PACKAGE / name
    return inside if inside.is_dir() else _PACKAGE.parent / name


def groups() -> list[str]:
    """Names of the config groups, e.g. ``planner``."""
    return sorted(p.name for p in resource_folder("conf").iterdir() if p.is_dir() and any(p.glob("*.yaml")))


def options_of(group: str) -> list[str]:
    """Names of the options of a config group, e.g. all experiments."""
    return sorted(p.stem for p in (resource_folder("conf") / group).glob("*.yaml"))


def compose(overrides: Sequence[str] = ()) -> dict[str, Any]:
    """The resolved config as plain data, with the scene's file read in.

    One number given for a list of numbers stands for as many of them as the list has:
    ``planner.hidden=64`` makes every hidden layer 64 wide.

    Args:
        overrides: Hydra overrides ``key=value``; ``group=option`` picks an option of a config group.

    Raises:
        ConfigError: one line that names the override or key, with the nearest known name.
    """
    parsed = [_parse(text) for text in overrides]
    choices = [o.input_line for o in parsed if _is_group(o.key_or_group)]
    values = [o for o in parsed if not _is_group(o.key_or_group)]
    before = _leaves_of(tuple(choices)) if values else {}
    for override in values:
        _check_override(override, before)
    config = _composed([o.input_line for o in parsed])
    for override in values:
        listed, given = before.get(override.key_or_group), override.value()
        if _is_numbers(listed) and _is_number(given):
            _put(config, override.key_or_group, [given] * len(listed))
    config["scene"] = load_scene(config["scene"])
    return config


def chosen_options(overrides: Sequence[str] = ()) -> dict[str, str]:
    """Which option of each config group is in use."""
    for text in overrides:
        _parse(text)
    return dict(_hydra(overrides, with_hydra=True).hydra.runtime.choices)


def _composed(overrides: Sequence[str]) -> dict[str, Any]:
    """What Hydra makes of the overrides, as plain data."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    try:
        config = OmegaConf.to_container(_hydra(overrides), resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as e:
        raise ConfigError(f"config: {_first_line(e)}") from None
    assert isinstance(config, dict)
    return config


def _hydra(overrides: Sequence[str], *, with_hydra: bool = False) -> Any:
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(config_dir=str(resource_folder("conf")), version_base="1.3"):
            return hydra_compose(config_name="config", overrides=list(overrides), return_hydra_config=with_hydra)
    except (HydraException, OmegaConfBaseException) as e:
        raise ConfigError(f"config: {_first_line(e)}") from None


def _parse(text: str) -> Any:
    """One override, parsed; group choices are checked here."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        override = OverridesParser.create().parse_override(text)
    except HydraException as e:
        raise ConfigError(f"'{text}' is not an override of the form key=value: {_first_line(e)}") from None
    if override.is_sweep_override():
        raise ConfigError(f"{text}: sweeps are not supported; give one value (lists are written [1,2])")
    if override.is_delete():
        raise ConfigError(f"{text}: keys cannot be removed; set another value")
    group = override.key_or_group
    if _is_group(group):
        choice, known = override.value(), options_of(group)
        if choice not in known:
            near = did_you_mean(str(choice), known)
            raise ConfigError(f"{group}={choice}: unknown {group}{near}; known: {', '.join(known)}")
    return override


def _check_override(override: Any, before: Mapping[str, Any]) -> None:
    """Complain about an unknown key, or a value of another type than the one it replaces."""
    key = override.key_or_group
    if override.is_add() or override.is_force_add():
        return
    if key not in before:
        top = sorted({k.partition(".")[0] for k in before})
        near = did_you_mean(key, before)
        raise ConfigError(f"{key}: unknown key{near}" + ("" if near else f"; known at the top: {', '.join(top)}"))
    if key in _OWN_CHECK:
        return
    old, new = before[key], override.value()
    section = before.get(key.rpartition(".")[0])
    if isinstance(section, dict) and "_target_" in section:
        return  # the constructor's signature says what is allowed
    whole = isinstance(old, int) and not isinstance(old, bool)
    if whole and (not isinstance(new, int) or isinstance(new, bool)):
        raise ConfigError(f"{key} must be a whole number (it is {old}), found {new!r}")
    if isinstance(old, float) and not _is_number(new):
        raise ConfigError(f"{key} must be a number (it is {old}), found {new!r}")
    if isinstance(old, dict) and not isinstance(new, dict):
        raise ConfigError(f"{key} is a section, found {new!r}; its keys: {', '.join(old)}")


_OWN_CHECK = ("scene", "verify.partitions", "verify.memory", "verify.budget")
"""Keys that take values of several types and are checked where they are read."""


def _is_group(key: str) -> bool:
    return (resource_folder("conf") / key).is_dir()


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_numbers(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(_is_number(v) for v in value)


@functools.cache
def _leaves_of(choices: tuple[str, ...]) -> Mapping[str, Any]:
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


def load_scene(scene: Any) -> Any:
    """Replace a scene's name or path by the content of its YAML file; mappings pass through."""
    if not isinstance(scene, str):
        return scene
    folder = resource_folder("data") / "scenes"
    path = folder / f"{scene}.yaml" if "/" not in scene and not scene.endswith((".yaml", ".yml")) else Path(scene)
    if not path.is_file():
        known = sorted(p.stem for p in folder.glob("*.yaml"))
        raise ConfigError(f"scene '{scene}': no such scene{did_you_mean(scene, known)}; known: {', '.join(known)}")
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as e:
        raise ConfigError(f"scene file {path}: not readable as YAML ({_first_line(e)})") from None
    if not isinstance(data, dict):
        raise ConfigError(f"scene file {path}: must hold a mapping, found {type(data).__name__}")
    return data


def _first_line(error: BaseException) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
