"""Cells proved here, one chunk after the other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import ClassVar

from sagemp_cli.verification.cells import CellProver, CellTubes, Chunk, Run


@dataclass(frozen=True)
class Serial:
    """This process alone, with one thread."""

    name: ClassVar[str] = "serial"

    @contextmanager
    def opened(self, prover: CellProver) -> Iterator[Run]:
        """See :class:`~sagemp_cli.verification.executors.executor.Executor`."""

        def run(chunks: Sequence[Chunk]) -> Iterator[tuple[int, CellTubes]]:
            for chunk in chunks:
                yield chunk.index, prover.prove(chunk)

        yield run
