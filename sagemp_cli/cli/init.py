"""``sagemp init``."""

from __future__ import annotations

import keyword
import re
from pathlib import Path
from typing import Annotated

import typer

from sagemp_cli.cli.command import examples
from sagemp_cli.errors import UsageError

EXAMPLES = examples("sagemp init my_robot", "cd my_robot; sagemp run --until verify")


def init(
    name: Annotated[str, typer.Argument(help="Name of the robot, and of the folder that is made for it.")],
) -> None:
    """Make a small project around a robot of your own, which runs as it stands.

    A robot in torch with a planner of its own, a scene, an experiment, a plan as CSV, a Makefile and a test; its
    README.md is a tutorial. Nothing that exists is replaced.
    """
    folder = make_project(name)
    typer.echo(f"made {folder}/: {', '.join(sorted(p.name for p in folder.iterdir()))}")
    typer.echo(f"next: cd {folder}; sagemp run --until verify   (README.md goes through it)")


def make_project(name: str) -> Path:
    """Copy the template into a new folder, its robot's name replaced.

    Raises:
        UsageError: the name cannot be a module's, belongs to a robot already, or the folder is there.
    """
    from sagemp_cli.config.folders import resource_folder
    from sagemp_cli.plugins import KINDS
    from sagemp_cli.storage.atomic import write_whole

    folder = Path(name)
    word = folder.name
    if not re.fullmatch(r"[a-z][a-z0-9_]*", word) or keyword.iskeyword(word) or word in ("test", "conf", "scenes"):
        raise UsageError(f"init {name}: a robot's name must be lower-case letters, digits and underscores")
    if word in KINDS["dynamics"].built_in:
        raise UsageError(f"init {name}: '{word}' is a robot of this package; pick another name")
    if folder.exists():
        raise UsageError(f"{folder}: exists already; nothing is replaced, pick another name")
    template = resource_folder("template")
    for source in sorted(p for p in template.rglob("*") if p.is_file() and "__pycache__" not in p.parts):
        target = folder / str(source.relative_to(template)).replace("my_robot", word)
        write_whole(target, _renamed(source.read_text(encoding="utf-8"), word).encode(), overwrite=False)
    return folder


def _renamed(text: str, word: str) -> str:
    camel = "".join(part.capitalize() for part in word.split("_"))
    return text.replace("my_robot", word).replace("MyRobot", camel).replace("My robot", word)
