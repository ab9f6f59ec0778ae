"""Where config files and scenes are, and what they hold: the project's own first, then the package's."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeGuard

from sagemp_cli.errors import ConfigError, did_you_mean
from sagemp_cli.plugins.project import current_project
from sagemp_cli.reading.plain_yaml import yaml_in
from sagemp_cli.reading.regular import is_there

_PACKAGE = Path(__file__).resolve().parents[1]


def resource_folder(name: str) -> Path:
    """The folder ``conf`` or ``data``: inside the installed package, or at the top of a checkout."""
    inside = _PACKAGE / name
    return inside if inside.is_dir() else _PACKAGE.parent / name


def config_folders() -> list[Path]:
    """Where config files are looked for, in order: the project's own ``conf/``, and the package's."""
    own, brought = current_project().conf, resource_folder("conf")
    return [brought] if own is None or own.resolve() == brought.resolve() else [own, brought]


def config_file(group: str, option: str) -> Path | None:
    """The file of an option of a config group; None for one that a plugin brings without a file."""
    found = (folder / group / f"{option}.yaml" for folder in config_folders())
    return next((path for path in found if path.is_file()), None)


def is_file(choice: Any) -> TypeGuard[str]:
    """Whether a choice is the path of a file, not a name."""
    return isinstance(choice, str) and choice.endswith((".yaml", ".yml"))


def load_scene(scene: Any) -> Any:
    """Replace a scene's name or path by the content of its YAML file; mappings pass through."""
    if not isinstance(scene, str):
        return scene
    folder = resource_folder("data") / "scenes"
    if "/" in scene or scene.endswith((".yaml", ".yml")):
        if not is_there(Path(scene)):
            raise ConfigError(f"scene '{scene}': no such file (looked for {Path(scene).resolve()})")
        return mapping_in(Path(scene), f"scene file {scene}")
    known = sorted(p.stem for p in folder.glob("*.yaml"))
    if scene not in known:
        raise ConfigError(
            f"scene '{scene}': no such scene{did_you_mean(scene, known)}; known: {', '.join(known)}; "
            f"one of your own is given as a file, scene=path/to/file.yaml"
        )
    return mapping_in(folder / f"{scene}.yaml", f"scene file {scene}")


def mapping_in(path: Path, what: str) -> dict[str, Any]:
    """The mapping in a YAML file.

    Args:
        path: the file.
        what: what it is, for messages.

    Raises:
        ConfigError: it is missing, too large, or not plain YAML, see :mod:`~sagemp_cli.reading.plain_yaml`, with a
            mapping in it.
    """
    data = yaml_in(path, what)
    if not isinstance(data, dict):
        raise ConfigError(f"{what}: must hold a mapping, found {type(data).__name__}")
    return data


def first_line(error: BaseException) -> str:
    """The first line of an error's message that says anything."""
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
