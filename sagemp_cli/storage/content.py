"""A hash of what an HDF5 file says, whatever way it is stored."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np

HASH_ATTRIBUTE = "content_sha256"


class ContentError(Exception):
    """A file whose content has no canonical form."""


def content_hash(file: Mapping[str, Any]) -> str:
    """SHA-256 over every group, dataset and attribute: its path, type, shape and bytes, in the order of names.

    The root attribute that holds the hash itself is left out. Compression, chunks and checksums do not matter.

    Args:
        file: an open HDF5 file, or what was read from one (:class:`~sagemp_cli.reading.tree.Group`).

    Raises:
        ContentError: a type other than numbers and text.
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

    def put_node(node: Any, level: int) -> None:
        group = isinstance(node, Mapping)
        put("node", node.name, "Dataset" if not group else "Group" if level else "File")
        for key in sorted(node.attrs):
            if not (level == 0 and key == HASH_ATTRIBUTE):
                put("attribute", key)
                put_value(node.attrs[key], f"attribute {node.name}@{key}")
        if not group:
            put_value(node[()], node.name)
            return
        for key in sorted(node):
            put_node(node[key], level + 1)

    put_node(file, 0)
    return digest.hexdigest()
