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
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sagemp_cli.errors import ArtifactError, did_you_mean
from sagemp_cli.reading.reader import read_arrays
from sagemp_cli.reading.regular import require_regular

REFERENCES = "references"
"""Name of the dataset that holds all states at once."""
TIME = "t"
LABEL = "trajectory"

LARGEST = 1e9
"""Size of a coordinate at most: float64 resolves a tenth of a micrometre there, and no robot gets that far."""

_HDF5 = (".h5", ".hdf5")
_LARGEST_CSV = 2**26
_LATEST = 1e20

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


def arrays_in(path: Path, wanted: Iterable[str] | None = None) -> tuple[list[str], dict[str, np.ndarray]]:
    """What is at the top of an HDF5 (.h5, .hdf5) or NPZ (.npz) file: names, and arrays of real numbers by name.

    Args:
        path: the file.
        wanted: names to read, where they are there; all if not given.

    Raises:
        ArtifactError: another kind of file, missing, unreadable, or a wanted one is not of real numbers.
    """
    if path.suffix.lower() not in (*_HDF5, ".npz"):
        raise ArtifactError(f"{path}: a file of references must be HDF5 ({', '.join(_HDF5)}) or NPZ (.npz)")
    names, arrays = read_arrays(path, None if wanted is None else list(wanted))
    for name, array in arrays.items():
        if array.dtype.kind not in "fiu":
            raise ArtifactError(f"{path}: '{name}' must hold real numbers, found type {array.dtype}")
    return names, arrays


def read_trajectories(path: Path, *, state_names: Sequence[str]) -> list[RecordedTrajectory]:
    """The trajectories in a file, in its order; see the module for what is recognised.

    Raises:
        ArtifactError: one line: missing, unreadable, a name that is not recognised, a shape that does not fit, a
            value that is no finite number, times that do not increase, fewer than two rows, none at all.
    """
    suffix = path.suffix.lower()
    if suffix not in (*_HDF5, ".npz", ".csv"):
        raise ArtifactError(f"{path}: trajectories must be in HDF5 ({', '.join(_HDF5)}), NPZ (.npz) or CSV (.csv)")
    found = _from_csv(path, state_names) if suffix == ".csv" else _from_arrays(path, state_names)
    for trajectory in found:
        _require_sound(path, trajectory)
    return found


def _from_arrays(path: Path, state_names: Sequence[str]) -> list[RecordedTrajectory]:
    arrays = {name: np.asarray(array, dtype=np.float64) for name, array in arrays_in(path)[1].items()}
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
    size = require_regular(path)
    if size > _LARGEST_CSV:
        raise ArtifactError(
            f"{path}: has {size >> 20} MiB; a CSV may have {_LARGEST_CSV >> 20} MiB, HDF5 and NPZ hold more"
        )
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            table = [(i, row) for i, row in enumerate(csv.reader(file), start=1) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as e:
        raise ArtifactError(f"{path}: cannot be read ({e})") from None
    if not table:
        raise ArtifactError(f"{path}: is empty; a header with {TIME} and state names is expected")
    header = [name.strip() for name in table[0][1]]
    if len(set(header)) < len(header):
        raise ArtifactError(f"{path}: has two columns '{Counter(header).most_common(1)[0][0]}'")
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
        most, unit = (_LATEST, " s; t is in seconds") if name == TIME else (LARGEST, "")
        if values is not None and (np.abs(values) > most).any():
            row = int(np.argmax(np.abs(values) > most))
            raise ArtifactError(f"{where} has {name} = {values[row]:g} in row {row}; at most {most:g}{unit} is allowed")
    if trajectory.time is not None and not (np.diff(trajectory.time) > 0).all():
        row = int(np.argmin(np.diff(trajectory.time) > 0)) + 1
        before, now = trajectory.time[row - 1], trajectory.time[row]
        raise ArtifactError(f"{where}: times must increase, but row {row} has {now!s} after {before!s}")
