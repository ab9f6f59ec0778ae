"""``sagemp inspect``."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sagemp_cli.cli.command import examples, printable
from sagemp_cli.cli.options import Json

if TYPE_CHECKING:
    from sagemp_cli.storage import Artifact, Kind

EXAMPLES = examples(
    "sagemp inspect artifacts/unicycle_node/certificate.h5",
    "sagemp inspect certificate.h5 --equations",
    "sagemp inspect artifacts/unicycle_node/library.h5 --json",
)


def inspect(
    file: Annotated[Path, typer.Argument(help="An artifact, i.e. an HDF5 file that a stage wrote.")],
    as_json: Json = False,
    equations: Annotated[
        bool,
        typer.Option("--equations", help="Show the step of a certificate or a library as equations, nothing else."),
    ] = False,
    config: Annotated[bool, typer.Option("--config", help="Print the config in the file, nothing else.")] = False,
) -> None:
    """Show what an artifact is, how and from what it was made, and what it holds.

    Everything is read and checked against the declaration of its kind; the content and the files that it was made
    from are compared by hash. Of a certificate or a library the claim is printed in full: what 'sagemp check' would
    prove, and what the file only says of itself.
    """
    from sagemp_cli.storage import open_header, read_any_artifact

    if equations:
        from sagemp_cli.checker.claim import equation_lines
        from sagemp_cli.checker.document import read_document

        typer.echo(printable("\n".join(equation_lines(read_document(file)))))
        return
    if config:
        import yaml

        typer.echo(printable(yaml.safe_dump(dict(open_header(file)[1].config), sort_keys=True)), nl=False)
        return
    kind, artifact = read_any_artifact(file)
    content = describe(kind, artifact) | {"claim": _claim(kind, file)}
    if as_json:
        typer.echo(json.dumps(content, indent=2))
    else:
        _print(content)


def describe(kind: Kind, artifact: Artifact[Any]) -> dict[str, Any]:
    """An artifact's kind, provenance, fields and verdicts as plain data."""
    header = artifact.header
    return {
        "file": str(artifact.path),
        "kind": kind.name,
        "format": kind.version,
        "sha256": artifact.sha256,
        "content": "as it was written" if artifact.unchanged else "CHANGED since it was written (its hash differs)",
        "stage": header.stage,
        "experiment": header.experiment,
        "seed": header.seed,
        "created_utc": header.created_utc,
        "seconds": header.seconds,
        "version": header.version,
        "packages": dict(header.packages),
        "parents": [
            {"role": p.role, "file": p.path, "sha256": p.sha256, "now": _now(artifact.path.parent / p.path, p.sha256)}
            for p in header.parents
        ],
        "fields": list(_fields(artifact.record, "")),
        "verdicts": _verdicts(artifact.record),
    }


def _claim(kind: Kind, path: Path) -> dict[str, Any] | None:
    """What a certificate or a library claims, and what it only says; None for other kinds."""
    if kind.name not in ("certificate", "library"):
        return None
    from sagemp_cli.checker.claim import claim_rows, said_rows
    from sagemp_cli.checker.document import read_document
    from sagemp_cli.errors import ArtifactError

    try:
        document = read_document(path)
    except ArtifactError as e:
        return {"claims": [["cannot be checked", str(e)]], "said": []}
    return {"claims": [list(row) for row in claim_rows(document)], "said": [list(row) for row in said_rows(document)]}


def _now(path: Path, sha256: str) -> str:
    from sagemp_cli.reading.regular import sha256_if_there

    found = sha256_if_there(path)
    return "not there" if found is None else "unchanged" if found == sha256 else "changed since"


def _fields(record: Any, prefix: str) -> list[dict[str, str]]:
    """One row per field: name, shape or value, named dimensions, units, meaning."""
    import numpy as np

    rows: list[dict[str, str]] = []
    for f in dataclasses.fields(record):
        value, meta, name = getattr(record, f.name), f.metadata, f"{prefix}{f.name}"
        row = {"name": name, "holds": "", "dims": " ".join(meta.get("dims", ())), "units": meta.get("units", "")}
        row["doc"] = meta["doc"]
        match meta["form"]:
            case "array":
                row["holds"] = "-" if value is None else f"{value.dtype} {tuple(value.shape)}"
            case "texts":
                row["holds"] = "-" if value is None else f"text ({len(value)},)"
            case "scalar":
                text = str(value)
                row["holds"] = text if len(text) <= 60 else f"{text[:57]}..."
            case "weights":
                count = sum(int(np.size(w)) for w in (value or {}).values())
                row["holds"] = "-" if value is None else f"{len(value)} arrays, {count} numbers"
            case "group" if meta["many"]:
                row["holds"] = "-" if value is None else f"{len(value)} groups"
        rows.append(row)
        if meta["form"] == "weights":
            rows += [
                {"name": f"{name}/{k}", "holds": f"{w.dtype} {tuple(w.shape)}", "dims": "", "units": "", "doc": ""}
                for k, w in (value or {}).items()
            ]
        if meta["form"] == "group" and value is not None:
            items = value if meta["many"] else (value,)
            for i, item in enumerate(items):
                rows += _fields(item, f"{name}/{f'{i:06d}/' if meta['many'] else ''}")
    return rows


def _verdicts(record: Any) -> list[str]:
    from sagemp_cli.sets.between import moment

    tubes = getattr(record, "tubes", None)
    if tubes is None:
        return []
    lines = [str(record.verdict)] if hasattr(record, "verdict") else []
    for i, verdict in enumerate(tubes.verdict):
        when = moment(int(tubes.step[i]), float(tubes.fraction[i]), record.loop.dt)
        decided = f" at {when} ({tubes.constraint[i]})" if tubes.step[i] >= 0 else ""
        lines.append(f"reference {i}: {verdict}{decided}")
    return lines


def _print(content: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text as Styled

    def text(value: str, style: str = "") -> Styled:
        return Styled(printable(value), style=style)

    console = Console()
    if not console.is_terminal:
        console = Console(width=200)  # nobody resizes a pipe: one line per field
    facts = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    keys = ("file", "kind", "stage", "experiment", "seed", "created_utc", "seconds", "version", "sha256")
    for key in (*keys, "content"):
        value = content[key]
        facts.add_row(text(key, style="bold"), text(f"{value:.1f}" if isinstance(value, float) else str(value)))
    facts.add_row(text("packages", style="bold"), text(", ".join(f"{k} {v}" for k, v in content["packages"].items())))
    for parent in content["parents"]:
        facts.add_row(text("made from", style="bold"), text(f"{parent['file']} ({parent['now']})"))
    for line in content["verdicts"]:
        facts.add_row(text("verdict", style="bold"), text(line))
    console.print(facts)
    claim = content["claim"] or {}
    for title, rows in (
        ("claimed, not checked here", claim.get("claims")),
        ("said by the file, not proved", claim.get("said")),
    ):
        if rows:
            lines = Table(box=None, show_header=False, padding=(0, 2, 0, 0), title=title, title_justify="left")
            for label, said in rows:
                lines.add_row(text(label, style="bold"), text(said))
            console.print(lines)
    table = Table(box=None, padding=(0, 2, 0, 0))
    for column in ("name", "holds", "dims", "units", "doc"):
        table.add_column(column, overflow="fold")
    for row in content["fields"]:
        table.add_row(*(text(row[c]) for c in ("name", "holds", "dims", "units", "doc")))
    console.print(table)
