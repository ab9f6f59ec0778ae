"""Snapshots of unfinished work: named arrays and one line of text in an HDF5 file, replaced atomically.

A checkpoint is private to the run that wrote it: it is not an artifact, nobody else reads it, and the run's
caller deletes it when the work is done. It holds plain arrays only, so reading one never runs code.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from sagemp_cli.errors import ArtifactError
from sagemp_cli.reading.reader import read_tree
from sagemp_cli.reading.tree import Group
from sagemp_cli.storage.atomic import hdf5_image, write_whole

_SCHEMA = "sagemp-checkpoint-1"


@dataclass(frozen=True)
class Resumable:
    """Where a run keeps its checkpoint, so that it goes on from there when it was interrupted.

    Attributes:
        path: of the checkpoint; it is written every ``every_seconds`` and on Ctrl-C.
        identity: what distinguishes this run from others beyond its schedule (a hash of config and data); a
            checkpoint of another identity is refused.
        every_seconds: see ``path``.
    """

    path: Path
    identity: str = ""
    every_seconds: float = 30.0

    def part(self, name: str) -> Resumable:
        """For a further run that belongs to the same work, in a file beside."""
        return Resumable(self.path.with_name(f"{self.path.stem}-{name}{self.path.suffix}"), self.identity)


@dataclass(frozen=True)
class Checkpoint:
    """What a checkpoint holds.

    Attributes:
        identity: one line that says which work this is; a run resumes only from a checkpoint of its own identity.
        arrays: arrays of numbers by name; a ``/`` in a name makes an HDF5 group.
    """

    identity: str
    arrays: Mapping[str, np.ndarray]


def write_checkpoint(path: Path, content: Checkpoint) -> None:
    """Write ``content`` so that ``path`` holds either the old or the new checkpoint, even after a power cut.

    Raises:
        ResourceError: the disk is full or the folder cannot be written.
    """

    def fill(file: h5py.File) -> None:
        file.attrs["schema"] = _SCHEMA
        file.attrs["identity"] = content.identity
        for name, value in content.arrays.items():
            file.create_dataset(name, data=value)

    write_whole(path, hdf5_image(fill), overwrite=True)


def read_checkpoint(path: Path, *, identity: str) -> Checkpoint:
    """Read back what :func:`write_checkpoint` wrote, to the last bit.

    Raises:
        ArtifactError: the file is damaged, no checkpoint, or belongs to work of another ``identity``.
    """
    try:
        file, _ = read_tree(path)
    except ArtifactError as error:
        why = str(error).removeprefix(f"{path}: ")
        raise ArtifactError(f"cannot read the checkpoint {path} ({why}); delete it to start over") from None
    schema, found = file.attrs.get("schema"), file.attrs.get("identity")
    if schema != _SCHEMA:
        raise ArtifactError(f"{path} is not a checkpoint (schema {schema!r}, expected '{_SCHEMA}')")
    if found != identity:
        raise ArtifactError(
            f"the checkpoint {path} belongs to other work ('{found}', expected '{identity}'); delete it to start over"
        )
    return Checkpoint(identity, dict(_arrays(file)))


def _arrays(group: Group, prefix: str = "") -> Iterator[tuple[str, np.ndarray]]:
    for name, node in group.items():
        if isinstance(node, Group):
            yield from _arrays(node, f"{prefix}{name}/")
        else:
            yield f"{prefix}{name}", node[()]
