"""What an HDF5 file says, in memory: groups, datasets and attributes, read like h5py's own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Dataset:
    """Numbers of any shape, or texts: an array of ``str`` (type ``object``), or one ``str``.

    Attributes:
        name: path in the file.
        value: what it holds.
        attrs: attributes, each a text, a number or an array of either.
    """

    name: str
    value: Any
    attrs: Mapping[str, Any] = field(default_factory=dict)

    @property
    def dtype(self) -> np.dtype:
        """Type of its numbers; ``object`` of texts."""
        return np.dtype(object) if isinstance(self.value, str) else self.value.dtype

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape; ``()`` of one value."""
        return () if isinstance(self.value, str) else self.value.shape

    def __getitem__(self, key: tuple[()]) -> Any:
        return self.value if isinstance(self.value, str) else self.value[key]


@dataclass(frozen=True)
class Group(Mapping[str, "Group | Dataset"]):
    """Members by name; a path with ``/`` leads into them.

    Attributes:
        name: path in the file, ``/`` of the file itself.
        members: groups and datasets.
        attrs: attributes, as of a :class:`Dataset`.
    """

    name: str
    members: Mapping[str, Group | Dataset]
    attrs: Mapping[str, Any] = field(default_factory=dict)

    def __getitem__(self, path: str) -> Group | Dataset:
        first, _, rest = path.partition("/")
        found = self.members[first]
        if not rest:
            return found
        if isinstance(found, Group):
            return found[rest]
        raise KeyError(path)

    def group(self, path: str) -> Group:
        """The group of that path; TypeError if it is none."""
        found = self[path]
        if not isinstance(found, Group):
            raise TypeError(f"{found.name} must be a group")
        return found

    def dataset(self, path: str) -> Dataset:
        """The dataset of that path; TypeError if it is none."""
        found = self[path]
        if not isinstance(found, Dataset):
            raise TypeError(f"{found.name} must be a dataset")
        return found

    def __iter__(self) -> Iterator[str]:
        return iter(self.members)

    def __len__(self) -> int:
        return len(self.members)
