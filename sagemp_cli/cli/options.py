"""The options that several commands share, and how they become config overrides."""

from __future__ import annotations

from typing import Annotated

import typer

from sagemp_cli.cli.completion import complete_override
from sagemp_cli.errors import UsageError

Overrides = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="KEY=VALUE",
        help="Config overrides, e.g. experiment=unicycle_node planner.hidden=32.",
        autocompletion=complete_override,
        show_default=False,
    ),
]
Seed = Annotated[int | None, typer.Option(help="Root of all random numbers; the same as seed=N.", show_default=False)]
SampleSeed = Annotated[
    int | None,
    typer.Option("--seed", help="Of what this stage samples; trained files are not affected.", show_default=False),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace the output if it exists already.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Say what would be read and written, and do nothing.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")]
TimeLimit = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        min=0.001,
        help="Stop after so long with exit code 124; finished pieces are kept.",
        show_default=False,
    ),
]
Partitions = Annotated[
    str | None,
    typer.Option(
        metavar="CELLS",
        help="Cells of the start box: a total (4), counts per uncertain dimension (2x2), or auto: split where needed.",
        show_default=False,
    ),
]


def overrides_of(
    given: list[str] | None, *, seed: int | None = None, partitions: str | None = None, seed_of: str = ""
) -> list[str]:
    """All overrides of a call: the positional ones, and those that options stand for.

    Args:
        given: positional ones.
        seed, partitions: values of the options.
        seed_of: section whose seed ``--seed`` is; empty for the root of all.

    Raises:
        UsageError: an option and an override say two things about one key.
    """
    overrides = list(given or [])
    for option, key, value in (
        ("--seed", f"{seed_of}.seed".lstrip("."), seed),
        ("--partitions", "proof.partitions", partitions),
    ):
        if value is None:
            continue
        if any(o.lstrip("+").startswith(f"{key}=") for o in overrides):
            raise UsageError(f"{option} {value} and the override {key}=... contradict each other; give one of them")
        text = str(value)
        overrides.append(f"{key}={text}" if text.lstrip("-").isdigit() else f"{key}={_quoted(text)}")
    return overrides


def _quoted(text: str) -> str:
    """A string in the grammar of overrides."""
    escaped = text.replace("\\", "\\\\").replace("'", "\\'")
    return f"'{escaped}'"
