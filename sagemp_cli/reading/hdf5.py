"""From an open HDF5 file to a tree, in the reader process: nothing is followed out of the file, sizes come first."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any, cast

import h5py
import numpy as np
from h5py import h5o  # pyright: ignore[reportAttributeAccessIssue]  (a compiled module without a stub)

from sagemp_cli.reading.budget import Budget, RefusedError
from sagemp_cli.reading.tree import Dataset, Group

MOST_LEVELS = 16
"""Groups in each other; an artifact has about 5."""
_MOST_TEXTS = 10_000
_MOST_LABELS = 32  # texts of an attribute: one for each dimension of a dataset
_AT_ONCE = 100
_FILTERS = (h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32)


def tree_of(file: h5py.Group, budget: Budget, *, without: Collection[str] = ()) -> Group:
    """A file or group with everything in it.

    Args:
        file: where to begin.
        budget: what it may unpack into.
        without: names at the top whose content is left out; they are empty groups then.

    Raises:
        RefusedError: a link, data in another file, an object of several names, what is neither numbers nor text, or
            more than the budget allows.
    """
    return _group(file, budget, 0, without)


def datasets_of(file: h5py.File, budget: Budget, wanted: Collection[str] | None) -> tuple[list[str], dict[str, Any]]:
    """Names at the top of a file, and the values of the ``wanted`` datasets among them (None: of all).

    Raises:
        RefusedError: one of them is a group, a link, or no numbers, see :func:`tree_of`.
    """
    names, found = list(file), {}
    for name in names if wanted is None else [n for n in wanted if n in names]:
        node = _member(file, name)
        if not isinstance(node, h5py.Dataset):
            raise RefusedError(f"'{name}' is a group; a dataset of numbers is expected there")
        _require_own(node, name)
        if node.dtype.kind not in "fiu":
            raise RefusedError(f"'{name}' must hold real numbers, found type {node.dtype}")
        found[name] = _value(node, f"'{name}'", budget, _MOST_TEXTS)
    return names, found


def _group(node: h5py.Group, budget: Budget, level: int, without: Collection[str]) -> Group:
    if level > MOST_LEVELS:
        raise RefusedError(f"groups are nested deeper than {MOST_LEVELS} levels")
    members: dict[str, Group | Dataset] = {}
    for name in cast("Iterable[str]", node):
        found = _member(node, name)
        if name in without and isinstance(found, h5py.Group):
            members[name] = Group(_path(found), {})
        elif isinstance(found, h5py.Dataset):
            where = _path(found)
            _require_own(found, where)
            members[name] = Dataset(where, _value(found, where, budget, _MOST_TEXTS), _attrs(found, budget))
        elif isinstance(found, h5py.Group):
            members[name] = _group(found, budget, level + 1, ())
        else:
            raise RefusedError(f"{found.name} is neither a group nor a dataset")
    return Group(_path(node), members, _attrs(node, budget))


def _path(node: h5py.Group | h5py.Dataset) -> str:
    assert isinstance(node.name, str)
    return node.name


def _member(node: h5py.Group, name: str) -> Any:
    where = f"{_path(node).rstrip('/')}/{name}"
    if not _is_text(name):
        raise RefusedError(f"a name in {node.name} is not UTF-8")
    if not isinstance(node.get(name, getlink=True), h5py.HardLink):
        raise RefusedError(f"{where} is a link; a file must hold all of its data itself")
    found = node[name]
    if h5o.get_info(found.id).rc != 1:
        raise RefusedError(f"an object in it has several names ({where} is one)")
    return found


def _require_own(node: h5py.Dataset, where: str) -> None:
    layout = node.id.get_create_plist()
    if node.is_virtual or node.external or layout.get_external_count():
        raise RefusedError(f"{where} is stored in another file; a file must hold all of its data itself")
    for i in range(layout.get_nfilters()):
        if layout.get_filter(i)[0] not in _FILTERS:
            raise RefusedError(f"{where} is packed in a way that is not read (filter {layout.get_filter(i)[0]})")


def _attrs(node: h5py.Group | h5py.Dataset, budget: Budget) -> dict[str, Any]:
    found = {}
    for key in node.attrs:
        where = f"attribute {node.name}@{key}"
        if not _is_text(key):
            raise RefusedError(f"the name of an attribute of {node.name} is not UTF-8")
        raw = node.attrs.get_id(key)
        _require_plain(raw, where, _MOST_LABELS)
        budget.take(int(np.prod(raw.shape)) * raw.dtype.itemsize)
        value = node.attrs[key]
        found[key] = _texts(value, where, budget) if raw.dtype.kind in "OSU" else value
    return found


def _value(node: h5py.Dataset, where: str, budget: Budget, most: int) -> Any:
    _require_plain(node, where, most)
    budget.take(node.size * node.dtype.itemsize)
    if node.dtype.kind not in "OS":
        return np.asarray(node[()])
    if not node.shape:
        return _texts(node[()], where, budget)
    pieces = [_texts(node[i : i + _AT_ONCE], where, budget) for i in range(0, len(node), _AT_ONCE)]
    return np.concatenate(pieces) if pieces else np.zeros(node.shape, dtype=object)


def _require_plain(node: h5py.Dataset | h5py.h5a.AttrID, where: str, most: int) -> None:
    """Numbers or texts, and of texts not too many to be measured one by one: each may be as long as the file."""
    if node.shape is None:
        raise RefusedError(f"{where} has no value")
    kind = node.dtype.kind
    if kind in "fiub" and node.dtype.itemsize <= 16 and not node.dtype.subdtype:
        return
    if kind not in "OSU" or (kind == "O" and h5py.check_string_dtype(node.dtype) is None):
        raise RefusedError(f"{where} holds neither numbers nor text (or it holds lists of any length)")
    if len(node.shape) > 1 or np.prod(node.shape) > most:
        raise RefusedError(f"{where} holds too many texts, more than {most}")


def _texts(value: Any, where: str, budget: Budget) -> Any:
    """One text, or an array of them, as ``str``."""
    if isinstance(value, np.ndarray) and value.shape:
        found = np.empty(value.shape, dtype=object)
        for i, item in enumerate(value.tolist()):
            found[i] = _texts(item, where, budget)
        return found
    value = value.item() if isinstance(value, np.generic | np.ndarray) else value
    budget.take(len(value))
    try:
        text = value.decode() if isinstance(value, bytes) else value
        if _is_text(text):
            return text
    except UnicodeDecodeError:
        pass
    raise RefusedError(f"{where} holds text that is not UTF-8")


def _is_text(value: Any) -> bool:
    """Whether it is a text that can be written down; h5py puts surrogates where bytes are not UTF-8."""
    try:
        return isinstance(value, str) and (value.isascii() or bool(value.encode()))
    except UnicodeEncodeError:
        return False
