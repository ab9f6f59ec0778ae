"""Plugins of this run: modules that the person at the keyboard names, on the command line or in the project's config.

A file is imported under its own name from its own folder, so that worker processes, which get this process's path, find
its classes again.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sagemp_cli.errors import ConfigError, SagempError, did_you_mean


def load(plugin: str, *, folder: Path | None = None) -> None:
    """Import a plugin, which registers what it brings.

    Args:
        plugin: a Python file, or the dotted name of a module, also of one below ``folder``.
        folder: what a relative path is relative to; the working directory if not given.

    Raises:
        ConfigError: there is no such file or module, its name belongs to another module, or it fails.
    """
    folder = Path.cwd() if folder is None else folder
    if plugin.endswith(".py") or "/" in plugin:
        path = (folder / plugin).resolve()
        if not path.is_file():
            raise ConfigError(f"plugin {plugin}: no such file")
        name, within = path.stem, path.parent
    else:
        path, name, within = None, plugin, folder.resolve()
    if not all(part.isidentifier() for part in name.split(".")):
        raise ConfigError(f"plugin {plugin}: '{name}' is no name of a module; use letters, digits and underscores")
    if str(within) not in sys.path:
        sys.path.append(str(within))  # last, so that nothing beside a plugin takes another module's place
    importlib.invalidate_caches()
    try:
        found = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        found = None
    if found is None:
        raise ConfigError(f"plugin {plugin}: there is no module '{name}'")
    if path is not None and (found.origin is None or Path(found.origin).resolve() != path):
        raise ConfigError(f"plugin {plugin}: '{name}' is the name of another module ({found.origin}); rename the file")
    try:
        importlib.import_module(name)
    except SagempError as e:
        raise type(e)(f"plugin {plugin}: {e}") from None
    except Exception as e:
        raise ConfigError(f"plugin {plugin}: {_where(e, found.origin)}{type(e).__name__}: {e}") from e


def load_all(plugins: Sequence[str], *, folder: Path | None = None) -> None:
    """Import several; see :func:`load`."""
    for plugin in plugins:
        load(plugin, folder=folder)


def load_object(target: str) -> tuple[Any, str]:
    """What a Python file defines, and a name for it.

    Args:
        target: ``path/to/file.py:name``, named by the person at the keyboard; it is imported like a plugin.

    Returns:
        The object, and ``file_name``.

    Raises:
        ConfigError: it names no file, the file fails, or it defines no such name.
    """
    file, colon, name = target.rpartition(":")
    if not colon or not file.endswith(".py") or not name.isidentifier():
        raise ConfigError(f"{target}: must be a Python file and a name in it, such as my_loop.py:step")
    load(file)
    module = sys.modules[Path(file).stem]
    if not hasattr(module, name):
        known = [n for n, value in vars(module).items() if callable(value) and not n.startswith("_")]
        raise ConfigError(f"{file}: defines no '{name}'{did_you_mean(name, known)}")
    return getattr(module, name), f"{Path(file).stem}_{name}"


def _where(error: Exception, origin: str | None) -> str:
    """The line of the plugin's own file that an error comes from."""
    if isinstance(error, SyntaxError) and error.lineno:
        return f"line {error.lineno}: "
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == origin]
    return f"line {lines[-1]}: " if lines else ""
