"""Artifacts: HDF5 files that say what they are, how they were made and from what.

An artifact appears under its final name whole or not at all (:mod:`sagemp_cli.storage.atomic`) and is never
overwritten unless asked for. On reading it is untrusted input: whatever does not fit is an
:class:`~sagemp_cli.errors.ArtifactError` that names the file and the place in it; nothing in it is executed.
"""

from __future__ import annotations

import datetime
import hashlib
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
from sagemp_cli.storage.atomic import hdf5_image, reason_of, refuse_existing, write_whole
from sagemp_cli.storage.content import HASH_ATTRIBUTE, content_hash
from sagemp_cli.storage.kinds import KINDS, Kind, kind_of
from sagemp_cli.storage.plain_yaml import plain_yaml
from sagemp_cli.storage.record import group_of, read_record, write_record

R = TypeVar("R")
_PACKAGES = ("torch", "numpy", "scipy", "h5py", "hydra-core")
_DAMAGE = (
    OSError,
    LookupError,
    RuntimeError,
    TypeError,
    ValueError,
    AttributeError,
    ArithmeticError,
    MemoryError,
    yaml.YAMLError,
)
"""What the HDF5, YAML and JSON readers raise on damaged files; a SagempError is none of them."""


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
        device: torch device used.
        created_utc, version, packages: filled when left empty.
    """

    stage: str
    experiment: str
    config: Mapping[str, Any]
    seed: int = 0
    parents: tuple[Parent, ...] = ()
    seconds: float = 0.0
    device: str = "cpu"
    created_utc: str = ""
    version: str = ""
    packages: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Artifact(Generic[R]):
    """A file that was read: where, its hash, its header and its record."""

    path: Path
    sha256: str
    header: Header
    record: R

    def as_parent(self, role: str, beside: Path) -> Parent:
        """This artifact as a parent of one that is written in the folder ``beside``."""
        return Parent(role, os.path.relpath(self.path, beside), self.sha256)


def sha256_of(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    with path.open("rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()


def write_artifact(path: Path, record: Any, header: Header, *, overwrite: bool = False) -> Path:
    """Write a record atomically under its final name.

    Raises:
        ArtifactError: the file exists and ``overwrite`` is false, or the record does not fit its declaration.
        NonFiniteError: a NaN or an infinity where the declaration allows none.
        ResourceError: the folder cannot be written or the disk is full; nothing is left behind.
    """
    kind = kind_of(record)
    refuse_existing(path, overwrite)

    def fill(file: h5py.File) -> None:
        _write_header(file, kind, header)
        write_record(file.create_group("data"), record)
        file.attrs[HASH_ATTRIBUTE] = content_hash(file)

    return write_whole(path, hdf5_image(fill), overwrite=overwrite)


def read_artifact(path: Path, record: type[R]) -> Artifact[R]:
    """Read a file as an artifact of one kind; the file is untrusted input.

    Raises:
        ArtifactError: missing, not HDF5, cut off, of another kind, of a newer format, or not as declared.
        NonFiniteError: NaN or infinity where the declaration allows none.
    """
    found = open_header(path)
    kind = next(k for k in KINDS if k.record is record)
    if found[0].name != kind.name:
        raise ArtifactError(f"{path}: is an artifact of kind '{found[0].name}', '{kind.name}' is needed here")
    with _open(path) as file:
        try:
            body = read_record(group_of(file, "data", f"{path}: /data"), record, str(path))
        except _DAMAGE as e:
            raise ArtifactError(f"{path}: damaged HDF5 data ({reason_of(e)})") from e
    return Artifact(path, sha256_of(path), found[1], body)


def open_header(path: Path) -> tuple[Kind, Header]:
    """The kind and provenance of any artifact, without reading its data."""
    with _open(path) as file:
        try:
            return _read_header(file, path)
        except _DAMAGE as e:
            raise ArtifactError(f"{path}: not an artifact of sagemp, or a damaged one ({reason_of(e)})") from e


def _open(path: Path) -> h5py.File:
    if not path.exists():
        raise ArtifactError(f"{path}: no such file")
    if path.is_dir():
        raise ArtifactError(f"{path}: is a folder, an HDF5 file is needed")
    try:
        return h5py.File(path, "r", locking="best-effort")
    except OSError as e:
        raise ArtifactError(f"{path}: not a readable HDF5 file ({reason_of(e)})") from e


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
        "device": header.device,
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


def _read_header(file: h5py.File, path: Path) -> tuple[Kind, Header]:
    schema = str(file.attrs.get("schema", ""))
    known = {f"sagemp/{k.name}": k for k in KINDS}
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
    if "data" not in file:
        raise ArtifactError(f"{path}: group /data is missing")
    config = plain_yaml(file["config"].asstr()[()])
    if not isinstance(config, dict):
        raise ArtifactError(f"{path}: /config must be a mapping, found {type(config).__name__}")
    parents = tuple(
        Parent(role, str(node.attrs["path"]), str(node.attrs["sha256"])) for role, node in file["parents"].items()
    )
    a = file.attrs
    header = Header(
        stage=str(a["stage"]),
        experiment=str(a["experiment"]),
        config=config,
        seed=int(a["seed"]),
        parents=parents,
        seconds=float(a["seconds"]),
        device=str(a["device"]),
        created_utc=str(a["created_utc"]),
        version=str(a["version"]),
        packages=json.loads(a["packages"]),
    )
    return kind, header
