"""The project in the working directory: its config folder ``conf/``, and what ``conf/project.yaml`` says.

``conf/project.yaml`` names the project's plugins and the experiment that commands are about unless they name one::

    plugins: [my_robot.py]
    experiment: my_robot
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sagemp_cli.errors import ConfigError, did_you_mean
from sagemp_cli.plugins.loading import load_all

FILE = "project.yaml"
_KEYS = ("plugins", "experiment")


@dataclass(frozen=True)
class Project:
    """What a working directory says.

    Attributes:
        folder: the working directory.
        conf: its config folder; None if it has none.
        plugins: modules of the project.
        experiment: what commands are about unless they name another experiment; None: the package's default.
    """

    folder: Path
    conf: Path | None = None
    plugins: tuple[str, ...] = ()
    experiment: str | None = None

    def load_plugins(self) -> None:
        """Import the project's plugins; those that are loaded already are left as they are."""
        load_all(self.plugins, folder=self.folder)


def current_project() -> Project:
    """The project of the working directory.

    Raises:
        ConfigError: ``conf/project.yaml`` is not what it should be.
    """
    folder = Path.cwd()
    conf = folder / "conf"
    if not conf.is_dir():
        return Project(folder)
    path = conf / FILE
    if not path.is_file():
        return Project(folder, conf)
    from sagemp_cli.reading.plain_yaml import yaml_in  # here: whoever bounds a loop of his own has no such file

    said = yaml_in(path, f"conf/{FILE}")
    said = {} if said is None else said
    if not isinstance(said, Mapping):
        raise ConfigError(f"conf/{FILE} must be a mapping with the keys {', '.join(_KEYS)}, found {said!r}")
    for key in said:
        if key not in _KEYS:
            near = did_you_mean(str(key), _KEYS) or f"; known: {', '.join(_KEYS)}"
            raise ConfigError(f"conf/{FILE}: unknown key '{key}'{near}")
    plugins, experiment = said.get("plugins") or [], said.get("experiment")
    if not isinstance(plugins, list) or not all(isinstance(p, str) for p in plugins):
        raise ConfigError(f"conf/{FILE}: plugins must be a list of Python files or modules, found {plugins!r}")
    if experiment is not None and not isinstance(experiment, str):
        raise ConfigError(f"conf/{FILE}: experiment must be a name, found {experiment!r}")
    return Project(folder, conf, tuple(plugins), experiment)
