"""Cells proved by the workers of a Dask cluster."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import Any, ClassVar

import numpy as np

from sagemp_cli.config.ranges import Positive
from sagemp_cli.errors import ConfigError, ResourceError
from sagemp_cli.verification.cells import CellProver, CellTubes, Chunk, Run


@dataclass(frozen=True)
class Dask:
    """The workers of a scheduler (dask.distributed), which need this version of sagemp installed.

    A chunk whose worker dies is proved by another one. Give each worker one thread (``dask worker --nthreads 1``) and
    the memory of one chunk, see ``proof.memory``. Functions and results travel as Dask sends them, which lets whoever
    is on the scheduler's network run code: use one that you trust.

    Attributes:
        address: of the scheduler, e.g. ``tcp://10.0.0.1:8786``.
        timeout: seconds to wait for the scheduler.
    """

    address: str
    timeout: Positive = 30.0
    name: ClassVar[str] = "dask"

    def __post_init__(self) -> None:
        if not self.address or "://" not in self.address:
            raise ConfigError(
                f"executor.address must be that of a Dask scheduler such as tcp://10.0.0.1:8786, found '{self.address}'"
            )

    @contextmanager
    def opened(self, prover: CellProver) -> Iterator[Run]:
        """See :class:`~sagemp_cli.verification.executors.executor.Executor`."""
        try:
            from distributed import Client, KilledWorker
        except ImportError:
            raise ConfigError(
                "executor=dask needs dask.distributed; install it with: pip install 'sagemp[dask]'"
            ) from None
        try:
            client = Client(self.address, timeout=self.timeout, set_as_default=False)
        except (OSError, ValueError) as e:
            first = str(e).partition("\n")[0]
            raise ResourceError(f"executor.address: no Dask scheduler answers at {self.address} ({first})") from None
        try:
            yield lambda chunks: _shared_out(client, prover, chunks)
        except KilledWorker as e:
            raise ResourceError(
                f"workers of {self.address} died one after the other over the same chunk (out of memory?): {e}"
            ) from None
        finally:
            client.close()


def _shared_out(client: Any, prover: CellProver, chunks: Sequence[Chunk]) -> Iterator[tuple[int, CellTubes]]:
    """Results as they are finished, with two chunks waiting for each thread of the cluster."""
    from distributed import as_completed

    def submit(chunk: Chunk) -> Any:
        # The prover goes with every chunk: data that lives on a worker would die with it.
        return client.submit(_prove, prover, chunk.index, chunk.arrays(), pure=False)

    waiting = iter(chunks)
    ahead = max(4, 2 * sum(client.nthreads().values()))
    running = as_completed([submit(chunk) for chunk in islice(waiting, ahead)], loop=client.loop)
    for future in running:
        index, arrays = future.result()
        for chunk in islice(waiting, 1):
            running.add(submit(chunk))
        yield index, CellTubes.of({name: np.array(a) for name, a in arrays.items()})


def _prove(prover: CellProver, index: int, arrays: Mapping[str, np.ndarray]) -> tuple[int, dict[str, np.ndarray]]:
    return index, prover.prove(Chunk.of(index, arrays)).arrays()
