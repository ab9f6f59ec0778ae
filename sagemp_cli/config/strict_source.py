"""Files of config that Hydra reads itself, in a folder of the user's own: only what can be read in one way gets there.

Hydra's YAML takes ``010`` for 8, ``1:30`` for 90 and ``yes`` for true. Scenes and artifacts are not read so, nor
is a config.
"""

from __future__ import annotations

from pathlib import Path

from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.plugins.config_source import ConfigResult

from sagemp_cli.reading.plain_yaml import yaml_in

SCHEME = "sagemp-own"


class StrictSource(FileConfigSource):
    """A folder whose files are read twice: by :func:`~sagemp_cli.reading.plain_yaml.plain_yaml`, then by Hydra."""

    @staticmethod
    def scheme() -> str:
        """What search paths of such folders begin with."""
        return SCHEME

    def load_config(self, config_path: str) -> ConfigResult:
        """A file of the folder.

        Raises:
            ConfigError: one line that names the file and the line in it.
        """
        path = Path(self.path) / self._normalize_file_name(config_path)
        if path.is_file():
            yaml_in(path, f"config file {_shown(path)}")
        return super().load_config(config_path)


def _shown(path: Path) -> Path:
    """The path as short as it can be said from here."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path
