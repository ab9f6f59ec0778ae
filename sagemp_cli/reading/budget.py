"""What reading a file may cost, by its size on the disk."""

from __future__ import annotations

ALWAYS = 2**28
"""Bytes that any file may unpack into: 256 MiB."""
RATIO = 20
"""Beyond that, so many times its size; the artifacts of this project unpack into less than 10 times what they are."""


class RefusedError(Exception):
    """A file that is not read, and why: one line without the file's name."""


class Budget:
    """Bytes that are left to unpack; asked for before anything is unpacked.

    Compression, chunks that are not there and texts that share their bytes each make a small file unpack into any size.
    """

    def __init__(self, size: int) -> None:
        """The budget of a file of ``size`` bytes."""
        self.left = self.allowed = most_bytes(size)

    def take(self, count: int) -> None:
        """Use ``count`` bytes.

        Raises:
            RefusedError: so many are not left.
        """
        self.left -= int(count)
        if self.left < 0:
            raise RefusedError(
                f"it unpacks into far more than a file of its size holds (more than {self.allowed >> 20} MiB)"
            )


def most_bytes(size: int) -> int:
    """What a file of ``size`` bytes may unpack into."""
    return max(ALWAYS, RATIO * size)


def most_seconds(size: int) -> int:
    """Processor time that reading it may take: 5 s, and a second for every 20 MB."""
    return 5 + size // 20_000_000
