"""How a reader process hands over what it read: a line of JSON and the arrays' bytes. Nothing is pickled."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import IO, Any, Protocol

import numpy as np

from sagemp_cli.reading.tree import Dataset, Group

_LENGTH = 8


class Readable(Protocol):
    """What a message is read from."""

    def readinto(self, buffer: memoryview, /) -> int | None:
        """Fill the beginning of the buffer; how much of it, 0 at the end."""
        ...


def send(stream: IO[bytes], message: Mapping[str, Any]) -> None:
    """Write a message: a mapping of plain data, arrays, groups and datasets, to any depth."""
    arrays: list[np.ndarray] = []
    text = json.dumps(_plain(message, arrays)).encode()
    stream.write(len(text).to_bytes(_LENGTH, "little"))
    stream.write(text)
    for array in arrays:
        stream.write(_bytes(array))
    stream.flush()


def receive(stream: Readable) -> Any:
    """Read a message.

    Raises:
        EOFError: the other side is gone.
    """
    data = json.loads(_exactly(stream, int.from_bytes(_exactly(stream, _LENGTH), "little")))
    return _restored(data, lambda array: _fill(stream, array))


def _plain(value: Any, arrays: list[np.ndarray]) -> Any:
    """The same as JSON; arrays are noted in the order in which :func:`_restored` meets them."""
    match value:
        case Group():
            members = {name: _plain(member, arrays) for name, member in value.members.items()}
            return {"group": value.name, "members": members, "attrs": _plain(dict(value.attrs), arrays)}
        case Dataset():
            return {
                "dataset": value.name,
                "value": _plain(value.value, arrays),
                "attrs": _plain(dict(value.attrs), arrays),
            }
        case dict():
            return {"mapping": {key: _plain(item, arrays) for key, item in value.items()}}
        case np.ndarray() if value.dtype.kind == "O":
            return {"texts": value.reshape(-1).tolist(), "shape": value.shape}
        case np.ndarray() | np.generic():
            array = np.ascontiguousarray(value)
            arrays.append(array)
            return {"array": array.dtype.str, "shape": value.shape, "one": isinstance(value, np.generic)}
    return {"plain": value}


def _restored(data: dict[str, Any], fill: Callable[[np.ndarray], None]) -> Any:
    match data:
        case {"group": name, "members": members, "attrs": attrs}:
            read = {key: _restored(member, fill) for key, member in members.items()}
            return Group(name, read, _restored(attrs, fill))
        case {"dataset": name, "value": value, "attrs": attrs}:
            return Dataset(name, _restored(value, fill), _restored(attrs, fill))
        case {"mapping": items}:
            return {key: _restored(item, fill) for key, item in items.items()}
        case {"texts": words, "shape": shape}:
            found = np.empty(len(words), dtype=object)
            found[:] = words
            return found.reshape(shape)
        case {"array": dtype, "shape": shape, "one": one}:
            array = np.empty(shape, dtype=np.dtype(dtype))
            fill(array)
            return array[()] if one else array
    return data["plain"]


def _fill(stream: Readable, array: np.ndarray) -> None:
    _read_into(stream, _bytes(array))


def _bytes(array: np.ndarray) -> memoryview:
    """The memory of a contiguous array as bytes."""
    return (array.reshape(-1).view(np.uint8) if array.nbytes else np.zeros(0, np.uint8)).data


def _exactly(stream: Readable, count: int) -> bytes:
    data = bytearray(count)
    _read_into(stream, memoryview(data))
    return bytes(data)


def _read_into(stream: Readable, view: memoryview) -> None:
    while view:
        got = stream.readinto(view)
        if not got:
            raise EOFError("the reader process is gone")
        view = view[got:]
