"""Arrays of an NPZ file, in the reader process; nothing is unpickled."""

from __future__ import annotations

import zipfile
from collections.abc import Collection
from typing import Any, BinaryIO

import numpy as np

from sagemp_cli.reading.budget import Budget, RefusedError


def arrays_of(file: BinaryIO, budget: Budget, wanted: Collection[str] | None) -> tuple[list[str], dict[str, Any]]:
    """Names of an archive's arrays, and the ``wanted`` ones among them (None: all).

    Raises:
        RefusedError: no archive, two arrays of a name, an array of neither numbers nor text, or more than the
            budget allows.
    """
    if not zipfile.is_zipfile(file):
        raise RefusedError("cannot be read (it is no NPZ archive, though its name says so)")
    with zipfile.ZipFile(file) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        names = list(members)
        if len(names) != len(archive.infolist()):
            raise RefusedError("holds two arrays of one name")
        found = {}
        for name in names if wanted is None else [n for n in wanted if n in names]:
            budget.take(members[name].file_size)
            with archive.open(members[name]) as raw:
                array = np.lib.format.read_array(raw, allow_pickle=False)
            if array.dtype.kind not in "fiubU":
                raise RefusedError(f"'{name}' must hold real numbers, found type {array.dtype}")
            found[name] = array
    return names, found
