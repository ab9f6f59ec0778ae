"""A hash of what an HDF5 file says, whatever way it is stored."""

from __future__ import annotations

import hashlib
from typing import Any

import h5py
import numpy as np

HASH_ATTRIBUTE = "content_sha256"
_MOST_LEVELS = 16


class ContentError(Exception):
    """A file whose content is not all in the file itself, or has no canonical form."""


def content_hash(file: h5py.File) -> str:
    """SHA-256 over every group, dataset and attribute: its path, type, shape and bytes, in the order of names.

    The root attribute that holds the hash itself is left out. Compression, chunks and checksums do not matter.

    Raises:
        ContentError: a link, data in another file, a type other than numbers and text, or groups nested too deep.
    """
    digest = hashlib.sha256()

    def put(*parts: str | bytes) -> None:
        for part in parts:
            data = part if isinstance(part, bytes) else part.encode()
            digest.update(len(data).to_bytes(8, "little"))
            digest.update(data)

    def put_value(value: Any, where: str) -> None:
        array = np.asarray(value)
        if array.dtype.kind in "OSU":
            words = [w.decode() if isinstance(w, bytes) else w for w in array.reshape(-1).tolist()]
            if not all(isinstance(w, str) for w in words):
                raise ContentError(f"{where} holds neither numbers nor text")
            put("text", str(array.shape), *words)
        elif array.dtype.kind in "fiub":
            little = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
            put(little.dtype.str, str(array.shape), little.tobytes())
        else:
            raise ContentError(f"{where} has type {array.dtype}, which has no canonical form")

    def put_node(node: h5py.Group | h5py.Dataset, level: int) -> None:
        put("node", node.name, type(node).__name__)
        for key in sorted(node.attrs):
            if not (level == 0 and key == HASH_ATTRIBUTE):
                put("attribute", key)
                put_value(node.attrs[key], f"attribute {node.name}@{key}")
        if isinstance(node, h5py.Dataset):
            if node.is_virtual or node.external:
                raise ContentError(f"{node.name} is stored in another file")
            put_value(node[()], node.name)
            return
        if level >= _MOST_LEVELS:
            raise ContentError(f"groups are nested deeper than {_MOST_LEVELS} levels")
        for key in sorted(node):
            if not isinstance(node.get(key, getlink=True), h5py.HardLink):
                raise ContentError(f"{node.name.rstrip('/')}/{key} is a link")
            put_node(node[key], level + 1)

    put_node(file, 0)
    return digest.hexdigest()
