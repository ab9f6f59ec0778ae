"""Options that experiments set are for what they pick: a planner's options do not stick to another planner."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sagemp_cli.config.folders import config_file, is_file, mapping_in
from sagemp_cli.plugins import KINDS
from sagemp_cli.plugins.project import current_project

Alone = Callable[[str, str], Mapping[str, Any]]

_DEFAULT_EXPERIMENT = "unicycle_node"
_OPTIONS = {group: (group,) for group in KINDS} | {
    "tracker_training": ("tracker_training",),
    "planner": ("planner", "planner_training"),
    "dynamics": ("dynamics", "dynamics_training"),
}
"""Groups whose options belong to what is picked, with the sections that they are in."""


def set_back_options_of_others(
    config: dict[str, Any], picked: Mapping[str, str], said: Sequence[str], *, alone: Alone
) -> None:
    """Where another planner is in use than an experiment picks, take back what the experiment says for its own one.

    An experiment may extend another one, whose options are for what that one picks. Of the groups this holds for, see
    :data:`_OPTIONS`.

    Args:
        config: changed in place.
        picked: options of groups that the command line picks.
        said: dotted keys that the command line sets itself.
        alone: what an option of a group says by itself.
    """
    chain = _experiments(picked.get("experiment") or current_project().experiment or _DEFAULT_EXPERIMENT)
    for group, sections in _OPTIONS.items():
        now = picked.get(group) or chain[-1][1].get(group)
        others = [body for body, choices in chain if choices.get(group, now) != now]
        if now is None or not others:
            continue
        own = [body for body, choices in chain if choices.get(group, now) == now]
        option = alone(group, now)
        for name in sections:
            usual = option.get(name) or {}
            for key, value in [item for body in others for item in (body.get(name) or {}).items()]:
                kept = any(key in (body.get(name) or {}) for body in own)
                if kept or any(f"{s}.".startswith(f"{name}.{key}.") for s in said) or config[name].get(key) != value:
                    continue
                if key in usual:
                    config[name][key] = usual[key]
                else:
                    del config[name][key]


def _experiments(name: str) -> list[tuple[Mapping[str, Any], dict[str, str]]]:
    """An experiment's file and those that it extends, which come first, each with the options that it picks."""
    path = Path(name) if is_file(name) else config_file("experiment", name)
    if path is None or not path.is_file():
        return [({}, {})]
    body, chain, choices = mapping_in(path, f"experiment file {path}"), [], {}
    for default in body.get("defaults") or []:
        if isinstance(default, str) and default != "_self_":
            chain += _experiments(default)
            choices |= chain[-1][1]
        elif isinstance(default, Mapping):
            choices |= {str(g).removeprefix("override ").lstrip("/"): str(option) for g, option in default.items()}
    return [*chain, (body, choices)]
