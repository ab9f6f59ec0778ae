"""References for ``verify.file``: whole states at every step of the horizon, taken as the exact numbers stored."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.errors import ArtifactError, UsageError
from sagemp_cli.planners.trajectory_file import LARGEST, REFERENCES, arrays_in
from sagemp_cli.verification.verification import require_finite


def read_references(path: Path, *, horizon: int, state_names: Sequence[str]) -> Tensor:
    """The references ``(count, K+1, n)`` in dataset ``references`` of an HDF5 (.h5, .hdf5) or NPZ (.npz) file.

    Nothing in the file is executed or unpickled. Numbers of another type become float64, which are then exact.

    Args:
        path: the file.
        horizon: K.
        state_names: of the robot, n of them.

    Raises:
        ArtifactError: missing, unreadable, without such a dataset of real numbers, or with one beyond
            :data:`~sagemp_cli.planners.trajectory_file.LARGEST`.
        UsageError: wrong shape or horizon.
        NonFiniteError: a NaN or an infinity.
    """
    (names, arrays), n = arrays_in(path, (REFERENCES,)), len(state_names)
    array = arrays.get(REFERENCES)
    if array is None:
        found = ", ".join(names[:20]) + ", ..." * (len(names) > 20)
        raise ArtifactError(f"{path}: has no dataset '{REFERENCES}'; found: {found or 'nothing'}")
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
    beyond = torch.nonzero(references.abs() > LARGEST)
    if len(beyond):
        r, k, i = beyond[0].tolist()
        raise ArtifactError(
            f"{path}: reference {r} has {state_names[i]} = {float(references[r, k, i]):g} at step {k}; "
            f"at most {LARGEST:g} is allowed"
        )
    return references
