"""References from a file of trajectories, wherever it comes from."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
import torch
from torch import Tensor

from sagemp_cli.errors import ArtifactError, UsageError
from sagemp_cli.reachability.verification import require_finite

REFERENCES = "references"
"""Name of the dataset, and role of such a file among an artifact's parents."""

_HDF5 = (".h5", ".hdf5")


def read_references(path: Path, *, horizon: int, state_names: Sequence[str]) -> Tensor:
    """The references ``(count, K+1, n)`` in dataset ``references`` of an HDF5 (.h5, .hdf5) or NPZ (.npz) file.

    Nothing in the file is executed or unpickled. Numbers of another type become float64, which are then exact.

    Args:
        path: the file.
        horizon: K.
        state_names: of the robot, n of them.

    Raises:
        ArtifactError: missing, unreadable, or without such a dataset of real numbers.
        UsageError: wrong shape or horizon.
        NonFiniteError: a NaN or an infinity.
    """
    suffix, n = path.suffix.lower(), len(state_names)
    if suffix not in (*_HDF5, ".npz"):
        raise ArtifactError(f"{path}: a file of references must be HDF5 ({', '.join(_HDF5)}) or NPZ (.npz)")
    if not path.is_file():
        raise ArtifactError(f"{path}: no such file (verify.file)")
    try:
        array = _from_hdf5(path) if suffix in _HDF5 else _from_npz(path)
    except (OSError, ValueError, KeyError, RuntimeError, EOFError, zipfile.BadZipFile) as e:
        raise ArtifactError(f"{path}: cannot be read ({' '.join(str(e).split())})") from None
    if array.ndim != 3 or array.shape[-1] != n or not len(array):
        raise UsageError(f"{path}: references must have shape (count, {horizon + 1}, {n}), found {array.shape}")
    if array.shape[1] != horizon + 1:
        raise UsageError(
            f"{path}: references have {array.shape[1] - 1} steps, but horizon is {horizon}; "
            f"they must have shape (count, {horizon + 1}, {n})"
        )
    references = torch.from_numpy(np.ascontiguousarray(array, dtype=np.float64))
    try:
        require_finite(references, state_names)
    except UsageError as e:
        raise type(e)(f"{path}: {e}") from None
    return references


def _from_hdf5(path: Path) -> np.ndarray:
    with h5py.File(path, "r", locking="best-effort") as file:
        found = file.get(REFERENCES)
        if not isinstance(found, h5py.Dataset):
            raise ArtifactError(f"{path}: has no dataset '{REFERENCES}'; found: {', '.join(file) or 'nothing'}")
        if found.dtype.kind not in "fiu":
            raise ArtifactError(f"{path}: '{REFERENCES}' must hold real numbers, found type {found.dtype}")
        return found[()]


def _from_npz(path: Path) -> np.ndarray:
    with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
        if not isinstance(file, np.lib.npyio.NpzFile):
            raise ArtifactError(f"{path}: is no NPZ archive, though its name says so")
        if REFERENCES not in file.files:
            raise ArtifactError(f"{path}: has no array '{REFERENCES}'; found: {', '.join(file.files) or 'nothing'}")
        array = file[REFERENCES]
        if array.dtype.kind not in "fiu":
            raise ArtifactError(f"{path}: '{REFERENCES}' must hold real numbers, found type {array.dtype}")
        return array
