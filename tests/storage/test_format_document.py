"""docs/artifacts.md says what the declarations say, field by field."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from sagemp_cli.storage import KINDS

TEXT = (Path(__file__).parents[2] / "docs" / "artifacts.md").read_text(encoding="utf-8")


def records():
    """Every record class with the heading of its section."""
    found = {kind.record: f"## {kind.name}" for kind in KINDS}
    waiting = list(found)
    while waiting:
        for f in dataclasses.fields(waiting.pop()):
            if f.metadata["form"] == "group" and f.metadata["record"] not in found:
                found[f.metadata["record"]] = f"### {f.metadata['record'].__name__}"
                waiting.append(f.metadata["record"])
    return found.items()


def section(heading):
    _, found, rest = TEXT.partition(f"\n{heading}\n")
    assert found, f"no section '{heading}'"
    return rest.partition("\n#")[0]


@pytest.mark.parametrize(("record", "heading"), records(), ids=lambda v: getattr(v, "__name__", None))
def test_every_field_is_described_with_its_dimensions_meaning_and_units(record, heading):
    rows = {line.split("|")[1].strip(): line for line in section(heading).splitlines() if line.startswith("| `")}
    assert list(rows) == [f"`{f.name}`" for f in dataclasses.fields(record)]
    for f in dataclasses.fields(record):
        row = rows[f"`{f.name}`"]
        assert f.metadata["doc"] in row
        if f.metadata["form"] == "array":
            assert f.metadata["dtype"] in row
            assert ("may be infinite or NaN" in row) == (not f.metadata["finite"])
        if f.metadata.get("dims"):
            assert f"({', '.join(f.metadata['dims'])})" in row
        if f.metadata.get("units"):
            assert f"in {f.metadata['units']}" in row


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.name)
def test_every_kind_is_described_with_its_version(kind):
    assert f"`sagemp/{kind.name}`, format version {kind.version}." in section(f"## {kind.name}")


def test_every_attribute_of_the_header_is_described(example, tmp_path):
    import h5py

    from sagemp_cli.storage import Header, write_artifact

    kind = KINDS[0]
    header = Header(stage="gen-data", experiment="e", config={})
    with h5py.File(write_artifact(tmp_path / "a.h5", example(kind.record), header)) as file:
        for name in file.attrs:
            assert f"| attribute `{name}` |" in TEXT
        assert all(f"`/{name}" in TEXT for name in file)
