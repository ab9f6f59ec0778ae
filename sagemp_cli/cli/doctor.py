"""``sagemp doctor``."""

from __future__ import annotations

import json
import os
import platform
import time
from importlib import metadata
from typing import Any

import typer

from sagemp_cli.cli.command import examples
from sagemp_cli.cli.options import Json

EXAMPLES = examples("sagemp doctor", "sagemp doctor --json | jq .propagators")
_PACKAGES = ("torch", "numpy", "scipy", "h5py", "hydra-core", "typer", "rich", "matplotlib")
_OPTIONAL = ("python-flint", "onnx", "auto_LiRPA", "neuralsat")


def doctor(as_json: Json = False) -> None:
    """Show versions and threads, and test which propagators work and are sound on a small loop.

    A propagator that is not installed is reported, not an error. Exit code 1 if one gives a wrong tube.
    """
    found = examine()
    if as_json:
        typer.echo(json.dumps(found, indent=2))
    else:
        _print(found)
    if any(p["state"] == "unsound" for p in found["propagators"]):
        raise typer.Exit(1)


def examine() -> dict[str, Any]:
    """Versions, threads and the propagators' tests as plain data."""
    import torch

    from sagemp_cli import __version__
    from sagemp_cli.config.composition import options_of
    from sagemp_cli.config.folders import resource_folder

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    return {
        "sagemp": __version__,
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        "packages": {name: _version(name) for name in (*_PACKAGES, *_OPTIONAL)},
        "threads": {
            "cores": os.cpu_count(),
            "torch": threads,
            "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS"),
            "advice": "export OMP_NUM_THREADS=1" if threads > 1 else "",
        },
        "config": str(resource_folder("conf")),
        "propagators": [_test(option) for option in options_of("propagator")],
    }


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _test(option: str) -> dict[str, Any]:
    """One propagator of the config: sound, unsound, or why it does not work here."""
    from sagemp_cli.config.binding import build
    from sagemp_cli.config.composition import compose
    from sagemp_cli.errors import SagempError
    from sagemp_cli.verification.selftest import sound_on_a_small_loop

    began = time.perf_counter()
    try:
        propagator = build(compose([f"propagator={option}"])["propagator"], "propagator")
        sound, width = sound_on_a_small_loop(propagator)
    except (SagempError, ImportError) as e:
        return {"name": option, "state": "not available", "why": " ".join(str(e).split())}
    return {
        "name": option,
        "state": "sound" if sound else "unsound",
        "why": "" if sound else "a sampled rollout leaves the tube of the test loop",
        "rigorous": propagator.rigorous,
        "width": width,
        "seconds": time.perf_counter() - began,
    }


def _absent(package: str, packages: dict[str, Any]) -> str:
    """What is said of a package that is not installed; neuralsat carries an auto_LiRPA of its own."""
    carried = package == "auto_LiRPA" and packages.get("neuralsat") is not None
    return "not installed by itself; the one that neuralsat carries is used" if carried else "not installed"


def _print(found: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console, threads = Console(), found["threads"]
    facts = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    for key, value in (
        ("sagemp", found["sagemp"]),
        ("python", f"{found['python']}, {found['machine']}"),
        *((name, version or _absent(name, found["packages"])) for name, version in found["packages"].items()),
        ("config", found["config"]),
        (
            "threads",
            f"torch {threads['torch']}, cores {threads['cores']}, OMP_NUM_THREADS={threads['OMP_NUM_THREADS']}",
        ),
        *((("advice", threads["advice"]),) if threads["advice"] else ()),
    ):
        facts.add_row(Text(key, style="bold"), Text(str(value)))
    console.print(facts)
    table = Table(box=None, padding=(0, 2, 0, 0))
    for column in ("propagator", "self-test", "rounding included", "seconds", "why"):
        table.add_column(column, overflow="fold")
    styles = {"sound": "green", "unsound": "bold red", "not available": "yellow"}
    for p in found["propagators"]:
        rigorous = {True: "yes", False: "no"}.get(p.get("rigorous"), "")
        seconds = f"{p['seconds']:.2f}" if "seconds" in p else ""
        table.add_row(p["name"], Text(p["state"], style=styles[p["state"]]), rigorous, seconds, Text(p["why"]))
    console.print(table)
