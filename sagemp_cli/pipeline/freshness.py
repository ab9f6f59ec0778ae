"""Which files of an experiment are fresh, stale, missing or damaged, and why.

A file is fresh if the config keys that its stage depends on are the same as now, and every input that it was
made from is fresh itself and has not changed a byte since. Only headers and hashes are read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from sagemp_cli.errors import ArtifactError
from sagemp_cli.pipeline.context import StageContext
from sagemp_cli.pipeline.stage import Stage, all_stages, stages_of
from sagemp_cli.reading.regular import is_there, sha256_if_there
from sagemp_cli.storage import Header, open_header, sha256_of
from sagemp_cli.storage.kinds import kind_of


class Freshness(StrEnum):
    """State of one file."""

    FRESH = "fresh"
    STALE = "stale"
    MISSING = "missing"
    DAMAGED = "damaged"
    """Not an artifact of this stage; ``run`` does not touch it."""


@dataclass(frozen=True)
class FileState:
    """One node of an experiment's graph of files.

    Attributes:
        stage: the stage that makes the file.
        path: where it is or would be.
        freshness: its state.
        why: one line, empty if fresh.
        header: its provenance, None if missing or damaged.
        sha256: hash of the file, empty if missing or damaged.
    """

    stage: Stage
    path: Path
    freshness: Freshness
    why: str = ""
    header: Header | None = None
    sha256: str = ""


def survey(context: StageContext, *, last: str | None = None) -> dict[str, FileState]:
    """The state of the file of every stage that the experiment has, in the order of the pipeline, by stage name.

    A file that comes from another experiment has the state that it has there.
    """
    states: dict[str, FileState] = {}
    for stage in stages_of(context.config, *([(last,)] if last else [])):
        owner = context.owner(stage.name)
        states[stage.name] = (
            _state_of(stage, context, states) if owner is context else survey(owner, last=stage.name)[stage.name]
        )
    return states


def _state_of(stage: Stage, context: StageContext, before: Mapping[str, FileState]) -> FileState:
    path = context.output_path(stage.name)
    if not is_there(path):
        return FileState(stage, path, Freshness.MISSING, f"make it with 'sagemp {stage.name}'")
    try:
        kind, header = open_header(path)
        wanted = kind_of(stage.record)
        if kind != wanted:
            raise ArtifactError(f"{path}: is an artifact of kind '{kind.name}', '{wanted.name}' is needed here")
    except ArtifactError as e:
        return FileState(stage, path, Freshness.DAMAGED, str(e).removeprefix(f"{path}: "))
    why = (
        _config_change(stage, header, context)
        or _input_change(stage, header, context, before)
        or _file_change(header, context)
    )
    return FileState(stage, path, Freshness.STALE if why else Freshness.FRESH, why, header, sha256_of(path))


def _config_change(stage: Stage, header: Header, context: StageContext) -> str:
    different = stage.difference(header.config, context.config)
    return "was made with {}={}, this config says {}".format(*different) if different else ""


def _input_change(stage: Stage, header: Header, context: StageContext, before: Mapping[str, FileState]) -> str:
    recorded = {parent.role: parent.sha256 for parent in header.parents}
    for name in stage.inputs_in(context.config):
        source = before[name]
        if source.freshness is not Freshness.FRESH:
            return f"its input {source.path.name} is {source.freshness}"
        if source.stage.role not in recorded:
            return f"it does not say which {source.path.name} it was made from"
        if recorded[source.stage.role] != source.sha256:
            return f"its input {source.path.name} has changed since"
    return ""


def _file_change(header: Header, context: StageContext) -> str:
    """Of files that no stage made, e.g. one of references; one that is gone cannot contradict what was made from it."""
    for parent in header.parents:
        source = context.folder / parent.path
        foreign = parent.role not in {stage.role for stage in all_stages()}
        if foreign and sha256_if_there(source) not in (None, parent.sha256):
            return f"{source.name} has changed since"
    return ""
