"""Trajectories in files that others wrote: HDF5, NPZ and CSV. Nothing in them is executed or unpickled.

What is recognised, by the robot's state names:

* HDF5 (.h5, .hdf5) and NPZ (.npz): either one dataset ``references`` with all states, ``(count, T, n)`` or ``(T, n)``,
  or one dataset per state, ``(count, T)`` or ``(T,)``. Beside them ``t``, the time in seconds, ``(T,)`` or
  ``(count, T)``.
* CSV (.csv): a header with state names, ``t`` for the time in seconds, and ``trajectory``, a label that says which rows
  belong together where there are several; without it all rows are one trajectory.

States may be missing except for the position; the time may be missing where rows are the robot's steps already.
"""

from __future__ import annotations

import csv
import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from sagemp_cli.errors import ArtifactError, did_you_mean

REFERENCES = "references"
"""Name of the dataset that holds all states at once."""
TIME = "t"
LABEL = "trajectory"

_HDF5 = (".h5", ".hdf5")

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RecordedTrajectory:
    """One trajectory as a file has it.

    Attributes:
        name: what to call it in messages.
        time: seconds ``(T,)``, strictly increasing; None where the file does not say.
        states: values ``(T,)`` by state name, finite; those that the file has.
    """

    name: str
    time: Array | None
    states: dict[str, Array]

    @property
    def rows(self) -> int:
        """Number of rows T."""
        return len(next(iter(self.states.values())))


def read_arrays(path: Path, wanted: Iterable[str] | None = None) -> dict[str, np.ndarray]:
    """The datasets of real numbers at the top of an HDF5 (.h5, .hdf5) or NPZ (.npz) file, by name.

    Args:
        path: the file.
        wanted: names to read, where they are there; all if not given.

    Raises:
        ArtifactError: another kind of file, missing, unreadable, or a wanted dataset is not of real numbers.
    """
    suffix = path.suffix.lower()
    if suffix not in (*_HDF5, ".npz"):
        raise ArtifactError(f"{path}: a file of references must be HDF5 ({', '.join(_HDF5)}) or NPZ (.npz)")
    if not path.is_file():
        raise ArtifactError(f"{path}: no such file")
    try:
        return _from_hdf5(path, wanted) if suffix in _HDF5 else _from_npz(path, wanted)
    except (OSError, ValueError, KeyError, RuntimeError, EOFError, zipfile.BadZipFile) as e:
        raise ArtifactError(f"{path}: cannot be read ({' '.join(str(e).split())})") from None


def names_in(path: Path) -> list[str]:
    """Names of what is at the top of an HDF5 or NPZ file that :func:`read_arrays` can read."""
    if path.suffix.lower() in _HDF5:
        with h5py.File(path, "r", locking="best-effort") as file:
            return list(file)
    with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
        return list(file.files)


def read_trajectories(path: Path, *, state_names: Sequence[str]) -> list[RecordedTrajectory]:
    """The trajectories in a file, in its order; see the module for what is recognised.

    Raises:
        ArtifactError: one line: missing, unreadable, a name that is not recognised, a shape that does not fit, a
            value that is no finite number, times that do not increase, fewer than two rows, none at all.
    """
    suffix = path.suffix.lower()
    if suffix not in (*_HDF5, ".npz", ".csv"):
        raise ArtifactError(f"{path}: trajectories must be in HDF5 ({', '.join(_HDF5)}), NPZ (.npz) or CSV (.csv)")
    if not path.is_file():
        raise ArtifactError(f"{path}: no such file")
    found = _from_csv(path, state_names) if suffix == ".csv" else _from_arrays(path, state_names)
    for trajectory in found:
        _require_sound(path, trajectory)
    return found


def _from_hdf5(path: Path, wanted: Iterable[str] | None) -> dict[str, np.ndarray]:
    with h5py.File(path, "r", locking="best-effort") as file:
        names = [name for name in (file if wanted is None else wanted) if name in file]
        for name in names:
            if not isinstance(file[name], h5py.Dataset):
                raise ArtifactError(f"{path}: '{name}' is a group; a dataset of numbers is expected there")
            _require_real(path, name, file[name].dtype)
        return {name: file[name][()] for name in names}


def _from_npz(path: Path, wanted: Iterable[str] | None) -> dict[str, np.ndarray]:
    with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
        if not isinstance(file, np.lib.npyio.NpzFile):
            raise ArtifactError(f"{path}: is no NPZ archive, though its name says so")
        arrays = {name: file[name] for name in (file.files if wanted is None else wanted) if name in file.files}
    for name, array in arrays.items():
        _require_real(path, name, array.dtype)
    return arrays


def _require_real(path: Path, name: str, dtype: np.dtype) -> None:
    if dtype.kind not in "fiu":
        raise ArtifactError(f"{path}: '{name}' must hold real numbers, found type {dtype}")


def _from_arrays(path: Path, state_names: Sequence[str]) -> list[RecordedTrajectory]:
    arrays = {name: np.asarray(array, dtype=np.float64) for name, array in read_arrays(path).items()}
    time = arrays.pop(TIME, None)
    if REFERENCES in arrays:
        table = arrays.pop(REFERENCES)
        table = table[None] if table.ndim == 2 else table
        if table.ndim != 3 or table.shape[-1] != len(state_names):
            raise ArtifactError(
                f"{path}: '{REFERENCES}' must have shape (count, rows, {len(state_names)}) for the states "
                f"{', '.join(state_names)}, found {table.shape}"
            )
        if arrays:
            raise ArtifactError(
                f"{path}: has '{REFERENCES}' with all states, so '{next(iter(arrays))}' is one too many"
            )
        arrays = {name: table[..., i] for i, name in enumerate(state_names)}
    _require_known(path, arrays, state_names, beside=(REFERENCES, TIME))
    arrays = {name: array[None] if array.ndim == 1 else array for name, array in arrays.items()}
    shape = next(iter(arrays.values())).shape
    for name, array in arrays.items():
        if array.ndim != 2 or array.shape != shape:
            raise ArtifactError(
                f"{path}: '{name}' has shape {array.shape}; all states need (count, rows), like {shape}"
            )
    if time is not None:
        if time.shape not in (shape[1:], shape):
            raise ArtifactError(f"{path}: '{TIME}' must have shape {shape[1:]} or {shape}, found {time.shape}")
        time = np.broadcast_to(time, shape)
    return [
        RecordedTrajectory(
            f"trajectory {i}", None if time is None else time[i], {name: array[i] for name, array in arrays.items()}
        )
        for i in range(shape[0])
    ]


def _from_csv(path: Path, state_names: Sequence[str]) -> list[RecordedTrajectory]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            table = [(i, row) for i, row in enumerate(csv.reader(file), start=1) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as e:
        raise ArtifactError(f"{path}: cannot be read ({e})") from None
    if not table:
        raise ArtifactError(f"{path}: is empty; a header with {TIME} and state names is expected")
    header = [name.strip() for name in table[0][1]]
    twice = next((name for name in header if header.count(name) > 1), None)
    if twice is not None:
        raise ArtifactError(f"{path}: has two columns '{twice}'")
    numbers = [name for name in header if name != LABEL]
    _require_known(path, [n for n in numbers if n != TIME], state_names, beside=(TIME, LABEL))
    groups: dict[str, list[list[float]]] = {}
    for line, row in table[1:]:
        if len(row) != len(header):
            raise ArtifactError(f"{path}: line {line} has {len(row)} values, the header has {len(header)}")
        cells = dict(zip(header, row, strict=True))
        values = [_number(cells[name], f"{path}: line {line}, column '{name}'") for name in numbers]
        groups.setdefault(cells.get(LABEL, "").strip(), []).append(values)
    found = []
    for label, rows in groups.items():
        columns = dict(zip(numbers, np.array(rows).T, strict=True))
        time = columns.pop(TIME, None)
        found.append(RecordedTrajectory(f"trajectory {label}" if LABEL in header else "trajectory", time, columns))
    return found


def _number(text: str, where: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ArtifactError(f"{where}: '{text}' is no number") from None


def _require_known(path: Path, names: Iterable[str], state_names: Sequence[str], beside: Sequence[str]) -> None:
    names = list(names)
    for name in names:
        if name not in state_names:
            known = (*state_names, *beside)
            near = did_you_mean(name, known)
            raise ArtifactError(f"{path}: '{name}' is not recognised{near}; recognised: {', '.join(known)}")
    if not names:
        raise ArtifactError(f"{path}: holds none of the states {', '.join(state_names)}")


def _require_sound(path: Path, trajectory: RecordedTrajectory) -> None:
    where = f"{path}: {trajectory.name}"
    if trajectory.rows < 2:
        raise ArtifactError(f"{where} has {trajectory.rows} rows; at least two are needed")
    for name, values in {TIME: trajectory.time, **trajectory.states}.items():
        if values is not None and not np.isfinite(values).all():
            row = int(np.argmin(np.isfinite(values)))
            raise ArtifactError(f"{where} has {name} = {values[row]} in row {row}; numbers must be finite")
    if trajectory.time is not None and not (np.diff(trajectory.time) > 0).all():
        row = int(np.argmin(np.diff(trajectory.time) > 0)) + 1
        before, now = trajectory.time[row - 1], trajectory.time[row]
        raise ArtifactError(f"{where}: times must increase, but row {row} has {now:g} after {before:g}")
