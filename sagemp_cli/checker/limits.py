"""What a file may cost to read: decided piece by piece, before anything as a whole is unpacked."""

from __future__ import annotations

import h5py
import numpy as np

_ALWAYS = 2**28
_RATIO = 100  # the artifacts of this project unpack into less than 10 times what they are
_MOST_TEXTS = 10_000
_MOST_LABELS = 32  # texts of an attribute: one for each dimension of a dataset


def require_readable(file: h5py.File, size: int) -> None:
    """Refuse a file of ``size`` bytes that would unpack into more than 256 MiB and more than 100 times its size.

    Compression, chunks that are not there, texts that share their bytes and groups with many names each make a small
    file unpack into any size.

    Raises:
        ValueError: it does, or it holds what is no certificate's: an object of several names, lists of any length.
    """
    total = 0

    def put(count: int) -> None:
        nonlocal total
        total += count
        if total > max(_ALWAYS, _RATIO * size):
            raise ValueError("it unpacks into far more than a certificate of its size holds")

    def visit(name: str, node: h5py.Group | h5py.Dataset) -> None:
        if h5py.h5o.get_info(node.id).rc != 1:
            raise ValueError("an object in it has several names")
        for key in node.attrs:
            if _is_text(node.attrs.get_id(key), _MOST_LABELS):
                put(sum(map(len, np.ravel(node.attrs[key]).tolist())))
        if not isinstance(node, h5py.Dataset) or node.is_virtual or node.external:
            return  # what is in another file is not read at all
        put((node.size or 0) * node.dtype.itemsize)
        if _is_text(node, _MOST_TEXTS):
            for begin in range(0, node.size, _RATIO):  # each may be as long as the file
                put(sum(map(len, node[begin : begin + _RATIO] if node.shape else [node[()]])))

    visit("/", file)
    file.visititems(visit)  # each object once


def _is_text(node: h5py.Dataset | h5py.h5a.AttrID, most: int) -> bool:
    """Whether its values are texts of any length, and not too many to be measured one by one."""
    if node.dtype.kind != "O" or node.shape is None:
        return False
    text = h5py.check_string_dtype(node.dtype) is not None
    if not text or len(node.shape) > 1 or np.prod(node.shape) > most:
        raise ValueError("it holds lists of any length, or too many texts")
    return True
