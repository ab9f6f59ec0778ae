"""Typed records: one frozen dataclass is one HDF5 group.

A record's fields are declared with :func:`array`, :func:`texts`, :func:`weights`, :func:`scalar` or
:func:`group`; the declaration carries the named dimensions, units and meaning, which are checked on
reading and on writing, stored beside the data, and printed by ``sagemp inspect``. Floating-point arrays must
be finite unless their declaration says otherwise.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from typing import Any, TypeVar

import h5py
import numpy as np

from sagemp_cli.errors import ArtifactError, NonFiniteError
from sagemp_cli.reading.tree import Dataset, Group

R = TypeVar("R")
_DIM = re.compile(r"^(?P<name>[A-Za-z_]+)(?P<shift>[+-]\d+)?$")
_LARGE, _MOST_SHRUNK = 2**24, 10
_SCALARS: dict[str, tuple[type, ...]] = {"str": (str,), "bool": (bool,), "int": (int,), "float": (float, int)}


def array(
    dims: str, doc: str, *, dtype: str = "float64", units: str = "", finite: bool = True, optional: bool = False
) -> Any:
    """Declare a numeric dataset.

    Args:
        dims: named dimensions separated by spaces, e.g. ``"count K+1 n"``; equal names must have equal sizes
            throughout the record, ``K+1`` is one more than ``K``. An empty string is a scalar dataset.
        doc: what it holds.
        dtype: stored type (``float64``, ``float32``, ``int64``, ``bool``, ``uint8``).
        units: stored as an attribute.
        finite: whether NaN and infinity are refused, on writing and on reading.
        optional: whether the field may be None.
    """
    return _declare("array", doc, dims=tuple(dims.split()), dtype=dtype, units=units, finite=finite, optional=optional)


def texts(dims: str, doc: str, *, optional: bool = False) -> Any:
    """Declare a dataset of UTF-8 strings of one dimension, held as a tuple of ``str``."""
    return _declare("texts", doc, dims=tuple(dims.split()), optional=optional)


def weights(doc: str, *, optional: bool = False) -> Any:
    """Declare a group of named numeric arrays of any shape (a ``state_dict``), one dataset per parameter."""
    return _declare("weights", doc, optional=optional)


def scalar(doc: str, *, units: str = "", optional: bool = False) -> Any:
    """Declare a ``float``, ``int``, ``bool`` or ``str`` stored as an attribute of the group."""
    return _declare("scalar", doc, units=units, optional=optional)


def group(record: type, doc: str, *, many: bool = False, optional: bool = False) -> Any:
    """Declare a nested record, or with ``many`` a tuple of them stored as numbered groups."""
    return _declare("group", doc, record=record, many=many, optional=optional)


def _declare(form: str, doc: str, **metadata: Any) -> Any:
    metadata = {"form": form, "doc": doc, "optional": False, **metadata}
    default: dict[str, Any] = {"default": None} if metadata["optional"] else {}
    return dataclasses.field(metadata=metadata, **default)


def write_record(node: h5py.Group, record: Any) -> None:
    """Write a record's fields into an HDF5 group, each checked against its declaration first.

    Raises:
        ArtifactError: a field is missing or its size or type is not as declared.
        NonFiniteError: NaN or infinity in an array that must be finite.
    """
    sizes: dict[str, int] = {}
    for f in dataclasses.fields(record):
        value, meta = getattr(record, f.name), f.metadata
        label = f"{type(record).__name__}.{f.name}"
        if value is None:
            if not meta["optional"]:
                raise ArtifactError(f"{label} is missing")
            continue
        match meta["form"]:
            case "array":
                data = np.asarray(value, dtype=meta["dtype"])
                _check_dims(label, meta["dims"], data.shape, sizes)
                if meta["finite"]:
                    _check_finite(label, meta["dims"], data)
                _dataset(node, f.name, data, meta)
            case "texts":
                data = np.asarray(list(value), dtype=object)
                _check_dims(label, meta["dims"], data.shape, sizes)
                d = node.create_dataset(f.name, data=data, dtype=h5py.string_dtype())
                d.attrs["doc"] = meta["doc"]
                d.dims[0].label = meta["dims"][0]
            case "weights":
                sub = node.create_group(f.name)
                sub.attrs["doc"] = meta["doc"]
                for key, weight in value.items():
                    data = np.asarray(weight)
                    _check_finite(f"{label}.{key}", (), data)
                    _dataset(sub, key, data, {"doc": "", "units": "", "dims": ()})
            case "scalar":
                node.attrs[f.name] = _scalar(label, f.type, value)
                if meta["units"]:
                    node.attrs[f"{f.name}.units"] = meta["units"]
            case "group":
                if meta["many"]:
                    sub = node.create_group(f.name)
                    sub.attrs["doc"] = meta["doc"]
                    sub.attrs["count"] = len(value)
                    for i, item in enumerate(value):
                        write_record(sub.create_group(f"{i:06d}"), item)
                else:
                    sub = node.create_group(f.name)
                    sub.attrs["doc"] = meta["doc"]
                    write_record(sub, value)


def _dataset(node: h5py.Group, name: str, data: np.ndarray, meta: Mapping[str, Any]) -> None:
    options: dict[str, Any] = {}
    if data.ndim and data.size:
        options["fletcher32"] = True
        if data.nbytes > 65536:
            options |= {"compression": "gzip", "compression_opts": 1, "shuffle": True}
    d = node.create_dataset(name, data=data, **options)
    if data.nbytes > _LARGE and data.nbytes > _MOST_SHRUNK * d.id.get_storage_size():
        del node[name]  # a reader takes what unpacks into many times its size for a bomb
        d = node.create_dataset(name, data=data, fletcher32=True)
    if meta["doc"]:
        d.attrs["doc"] = meta["doc"]
    if meta["units"]:
        d.attrs["units"] = meta["units"]
    for axis, dim in enumerate(meta["dims"]):
        d.dims[axis].label = dim


def read_record(node: Group, record: type[R], where: str) -> R:
    """Read a record from what an HDF5 group holds; whatever does not fit the declaration is an :class:`ArtifactError`.

    Args:
        node: the group.
        record: the record class.
        where: how to name the file in messages.
    """
    sizes: dict[str, int] = {}
    values: dict[str, Any] = {}
    for f in dataclasses.fields(record):  # type: ignore[arg-type]
        meta, name = f.metadata, f.name
        label = f"{where}: {node.name.rstrip('/')}/{name}"
        present = name in node.attrs if meta["form"] == "scalar" else name in node
        if not present:
            if not meta["optional"]:
                raise ArtifactError(f"{label} is missing")
            values[name] = None
            continue
        match meta["form"]:
            case "scalar":
                raw = node.attrs[name]
                values[name] = _scalar(label, f.type, raw)
            case "array":
                stored = _dataset_of(node, name, label)
                if stored.dtype != np.dtype(meta["dtype"]):
                    raise ArtifactError(f"{label} has type {stored.dtype}, {meta['dtype']} is required")
                _check_dims(label, meta["dims"], stored.shape, sizes)
                data = stored[()]
                if meta["finite"]:
                    _check_finite(label, meta["dims"], data)
                values[name] = data
            case "texts":
                stored = _dataset_of(node, name, label)
                if stored.dtype.kind != "O":
                    raise ArtifactError(f"{label} must hold text, found type {stored.dtype}")
                _check_dims(label, meta["dims"], stored.shape, sizes)
                values[name] = tuple(stored[()])
            case "weights":
                sub = group_of(node, name, label)
                values[name] = {key: _numeric(sub, key, f"{label}/{key}") for key in sub}
            case "group" if meta["many"]:
                sub = group_of(node, name, label)
                count = _scalar(f"{label}/count", "int", sub.attrs.get("count", len(sub)))
                if count != len(sub):
                    raise ArtifactError(f"{label} should hold {count} groups, found {len(sub)}")
                values[name] = tuple(
                    read_record(group_of(sub, f"{i:06d}", label), meta["record"], where) for i in range(count)
                )
            case "group":
                values[name] = read_record(group_of(node, name, label), meta["record"], where)
    return record(**values)


def _dataset_of(node: Group, name: str, label: str) -> Dataset:
    found = node.get(name)
    if not isinstance(found, Dataset):
        raise ArtifactError(f"{label} must be a dataset")
    return found


def group_of(node: Group, name: str, label: str) -> Group:
    """A member of ``node`` that is a group; ``label`` names it in messages."""
    found = node.get(name)
    if not isinstance(found, Group):
        raise ArtifactError(f"{label} must be a group{'' if found is not None else ' and is missing'}")
    return found


def _numeric(node: Group, name: str, label: str) -> np.ndarray:
    data = np.asarray(_dataset_of(node, name, label)[()])
    if data.dtype.kind not in "fiub":
        raise ArtifactError(f"{label} must be numeric, found type {data.dtype}")
    _check_finite(label, (), data)
    return data


def _scalar(label: str, declared: Any, value: Any) -> Any:
    """The value if it is of the declared type (``"str"``, ``"int"``, ``"float"`` or ``"bool"``)."""
    name = getattr(declared, "__name__", str(declared)).removesuffix(" | None")
    value = value.item() if isinstance(value, np.generic) else value
    if not isinstance(value, _SCALARS[name]) or (isinstance(value, bool) and name != "bool"):
        raise ArtifactError(f"{label} must be of type {name}, found {type(value).__name__}")
    return float(value) if name == "float" else value


def _check_finite(label: str, dims: tuple[str, ...], data: np.ndarray) -> None:
    if data.dtype.kind != "f" or np.isfinite(data).all():
        return
    place = tuple(int(i) for i in np.argwhere(~np.isfinite(data))[0])
    names = dims or tuple(f"index{i}" for i in range(data.ndim))
    where = ", ".join(f"{n.partition('+')[0]} {i}" for n, i in zip(names, place, strict=True))
    raise NonFiniteError(
        f"{label} is {data[place]} at {where or 'its only entry'}; only finite numbers are allowed there"
    )


def _check_dims(label: str, dims: tuple[str, ...], shape: tuple[int, ...], sizes: dict[str, int]) -> None:
    if len(dims) != len(shape):
        raise ArtifactError(f"{label} must have dimensions ({', '.join(dims)}), found shape {tuple(shape)}")
    for dim, size in zip(dims, shape, strict=True):
        match = _DIM.match(dim)
        assert match is not None, dim
        base = size - int(match["shift"] or 0)
        if sizes.setdefault(match["name"], base) != base:
            wanted = sizes[match["name"]] + int(match["shift"] or 0)
            raise ArtifactError(f"{label}: dimension {dim} should have size {wanted}, found {size}")
