"""Artifacts: HDF5 files that say what they are, how they were made and from what.

An artifact appears under its final name whole or not at all (:mod:`sagemp_cli.storage.atomic`) and is never
overwritten unless asked for. On reading it is untrusted input: whatever does not fit is an
:class:`~sagemp_cli.errors.ArtifactError` that names the file and the place in it; nothing in it is executed.
"""

from __future__ import annotations

import datetime
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any, Generic, TypeVar

import h5py
import numpy as np
import yaml

from sagemp_cli import __version__
from sagemp_cli.errors import ArtifactError
from sagemp_cli.reading.plain_json import plain_mapping
from sagemp_cli.reading.plain_yaml import plain_yaml
from sagemp_cli.reading.reader import read_tree
from sagemp_cli.reading.tree import Group
from sagemp_cli.storage.atomic import hdf5_image, reason_of, refuse_existing, write_whole
from sagemp_cli.storage.content import HASH_ATTRIBUTE, ContentError, content_hash
from sagemp_cli.storage.kinds import KINDS, Kind, kind_of, own_kinds
from sagemp_cli.storage.record import group_of, read_record, write_record

R = TypeVar("R")
_PACKAGES = ("torch", "numpy", "scipy", "h5py", "hydra-core")
_DAMAGE = (
    LookupError,
    RuntimeError,
    TypeError,
    ValueError,
    AttributeError,
    ArithmeticError,
    yaml.YAMLError,
)
"""What reading fields, YAML and JSON of a damaged file raises; a SagempError is none of them."""


@dataclass(frozen=True)
class Parent:
    """A file that an artifact was made from.

    Attributes:
        role: the stage output it stands for, e.g. ``demonstrations``.
        path: path relative to the artifact's folder where possible.
        sha256: hash of the whole file at the time.
    """

    role: str
    path: str
    sha256: str


@dataclass(frozen=True)
class Header:
    """Provenance, stored as root attributes and the ``config`` dataset.

    Attributes:
        stage: command that made the file, e.g. ``gen-data``.
        experiment: name of the experiment.
        config: resolved config as plain data.
        seed: root seed.
        parents: files read.
        seconds: wall-clock seconds of the stage.
        created_utc, version, packages: filled when left empty.
    """

    stage: str
    experiment: str
    config: Mapping[str, Any]
    seed: int = 0
    parents: tuple[Parent, ...] = ()
    seconds: float = 0.0
    created_utc: str = ""
    version: str = ""
    packages: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Artifact(Generic[R]):
    """A file that was read: where, its hash, its header and its record.

    Attributes:
        path, sha256: the file, and the hash of the bytes that were read.
        header, record: what is in it.
        unchanged: whether its content is still what was written, by the hash in it; it finds accidents, no forgers.
    """

    path: Path
    sha256: str
    header: Header
    record: R
    unchanged: bool = True

    def as_parent(self, role: str, beside: Path) -> Parent:
        """This artifact as a parent of one that is written in the folder ``beside``."""
        return Parent(role, os.path.relpath(self.path, beside), self.sha256)


def write_artifact(path: Path, record: Any, header: Header, *, overwrite: bool = False) -> Path:
    """Write a record atomically under its final name.

    Raises:
        ArtifactError: the file exists and ``overwrite`` is false, or the record does not fit its declaration.
        NonFiniteError: a NaN or an infinity where the declaration allows none.
        ResourceError: the folder cannot be written or the disk is full; nothing is left behind.
    """
    kind = kind_of(type(record))
    refuse_existing(path, overwrite)

    def fill(file: h5py.File) -> None:
        _write_header(file, kind, header)
        write_record(file.create_group("data"), record)
        file.attrs[HASH_ATTRIBUTE] = content_hash(file)

    return write_whole(path, hdf5_image(fill), overwrite=overwrite)


def read_artifact(path: Path, record: type[R]) -> Artifact[R]:
    """Read a file as an artifact of one kind; the file is untrusted input.

    Raises:
        ArtifactError: missing, not HDF5, cut off, of another kind, of a newer format, not as declared, or not what was
            written, see :attr:`Artifact.unchanged`.
        NonFiniteError: NaN or infinity where the declaration allows none.
    """
    wanted, (tree, sha256) = kind_of(record), read_tree(path)
    kind, header = _header(tree, path)
    if kind != wanted:
        raise ArtifactError(f"{path}: is an artifact of kind '{kind.name}', '{wanted.name}' is needed here")
    artifact = _artifact(path, sha256, kind, header, tree)
    if not artifact.unchanged:
        raise ArtifactError(
            f"{path}: the content was changed after it was written (its hash differs); make it again with --overwrite"
        )
    return artifact


def read_any_artifact(path: Path) -> tuple[Kind, Artifact[Any]]:
    """Read a file as an artifact of the kind that it says it is of, see :func:`read_artifact`, changed or not."""
    tree, sha256 = read_tree(path)
    kind, header = _header(tree, path)
    return kind, _artifact(path, sha256, kind, header, tree)


def _artifact(path: Path, sha256: str, kind: Kind, header: Header, tree: Group) -> Artifact[Any]:
    try:
        body = read_record(group_of(tree, "data", f"{path}: /data"), kind.record, str(path))
        unchanged = tree.attrs.get(HASH_ATTRIBUTE) == content_hash(tree)
    except ContentError as e:
        raise ArtifactError(f"{path}: {e}") from e
    except _DAMAGE as e:
        raise ArtifactError(f"{path}: damaged HDF5 data ({reason_of(e)})") from e
    return Artifact(path, sha256, header, body, unchanged)


def open_header(path: Path) -> tuple[Kind, Header]:
    """The kind and provenance of any artifact, without reading its data."""
    return _header(read_tree(path, without=("data",))[0], path)


def _header(tree: Group, path: Path) -> tuple[Kind, Header]:
    try:
        return _read_header(tree, path)
    except _DAMAGE as e:
        raise ArtifactError(f"{path}: not an artifact of sagemp, or a damaged one ({reason_of(e)})") from e


def _write_header(file: h5py.File, kind: Kind, header: Header) -> None:
    packages = dict(header.packages) or {p: metadata.version(p) for p in _PACKAGES}
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    for key, value in {
        "schema": f"sagemp/{kind.name}",
        "schema_version": kind.version,
        "stage": header.stage,
        "experiment": header.experiment,
        "seed": header.seed,
        "seconds": float(header.seconds),
        "created_utc": header.created_utc or now,
        "version": header.version or __version__,
        "packages": json.dumps(packages, sort_keys=True),
        "status": "complete",
    }.items():
        file.attrs[key] = value
    text = yaml.safe_dump(dict(header.config), sort_keys=True)
    file.create_dataset("config", data=text, dtype=h5py.string_dtype())
    parents = file.create_group("parents")
    for parent in header.parents:
        node = parents.create_group(parent.role)
        node.attrs["path"] = parent.path
        node.attrs["sha256"] = parent.sha256


def _read_header(file: Group, path: Path) -> tuple[Kind, Header]:
    schema = str(file.attrs.get("schema", ""))
    known = {f"sagemp/{k.name}": k for k in KINDS}
    if schema not in known:
        known |= {f"sagemp/{k.name}": k for k in own_kinds()}
    if schema not in known:
        raise ArtifactError(
            f"{path}: not an artifact of sagemp (schema '{schema or 'none'}'; known: {', '.join(known)})"
        )
    kind = known[schema]
    version = int(np.asarray(file.attrs["schema_version"]).item())
    if version > kind.version:
        raise ArtifactError(
            f"{path}: format {version} of '{kind.name}' is newer than this sagemp reads"
            f" (up to {kind.version}); update sagemp"
        )
    if version < kind.oldest:
        raise ArtifactError(f"{path}: format {version} of '{kind.name}' is an old one; make it again: {kind.command}")
    if "data" not in file:
        raise ArtifactError(f"{path}: group /data is missing")
    config = plain_yaml(_text(file.dataset("config")[()]))
    if not isinstance(config, dict):
        raise ArtifactError(f"{path}: /config must be a mapping, found {type(config).__name__}")
    parents = tuple(
        Parent(role, _text(node.attrs["path"]), _text(node.attrs["sha256"]))
        for role, node in file.group("parents").items()
    )
    a = file.attrs
    header = Header(
        stage=_text(a["stage"]),
        experiment=_text(a["experiment"]),
        config=config,
        seed=int(a["seed"]),
        parents=parents,
        seconds=float(a["seconds"]),
        created_utc=_text(a["created_utc"]),
        version=_text(a["version"]),
        packages={key: _text(value) for key, value in plain_mapping(a["packages"], "packages").items()},
    )
    return kind, header


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"a text is needed where {value!r} is")
    return value
