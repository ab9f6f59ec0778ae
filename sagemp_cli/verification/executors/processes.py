"""Cells proved by worker processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import ClassVar

import numpy as np

from sagemp_cli.config.ranges import Count, Whole
from sagemp_cli.errors import ResourceError
from sagemp_cli.verification.cells import CellProver, CellTubes, Chunk, Run
from sagemp_cli.verification.executors.serial import Serial
from sagemp_cli.workers import be_a_worker, one_thread_per_child

_prover: CellProver | None = None  # a worker's own copy, sent once when it starts


@dataclass(frozen=True)
class Processes:
    """Spawned workers with one thread each. Memory: each holds one chunk, see ``proof.memory``.

    Attributes:
        workers: how many; None for one per core.
        least: with fewer cells than that to prove, or with one chunk or worker, the work is done here: a worker
            takes seconds to start.
    """

    workers: Count | None = None
    least: Whole = 256
    name: ClassVar[str] = "processes"

    @contextmanager
    def opened(self, prover: CellProver) -> Iterator[Run]:
        """See :class:`~sagemp_cli.verification.executors.executor.Executor`; workers start when they are needed."""
        workers = self.workers or _cores()
        pool: ProcessPoolExecutor | None = None

        def run(chunks: Sequence[Chunk]) -> Iterator[tuple[int, CellTubes]]:
            nonlocal pool
            small = sum(map(len, chunks)) < self.least or len(chunks) < 2
            if workers == 1 or (small and pool is None):
                with Serial().opened(prover) as here:
                    yield from here(chunks)
                return
            if pool is None:
                pool = ProcessPoolExecutor(
                    workers,
                    mp_context=multiprocessing.get_context("spawn"),
                    initializer=_start,
                    initargs=(prover,),
                )
            yield from _shared_out(pool, chunks, ahead=2 * workers)

        try:
            yield run
        except BrokenProcessPool:
            raise ResourceError(
                "a worker process died (out of memory?); run again to go on, "
                "with fewer executor.workers or less proof.memory"
            ) from None
        finally:
            if pool is not None:
                pool.shutdown(wait=True, cancel_futures=True)


def _cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _shared_out(pool: ProcessPoolExecutor, chunks: Sequence[Chunk], *, ahead: int) -> Iterator[tuple[int, CellTubes]]:
    """Results as they are finished; few are waiting at any time, so that the chunks' inputs are not all held twice."""
    waiting = iter(chunks)
    with one_thread_per_child():  # the first submissions start the processes, which inherit the variables
        running: set[Future] = {pool.submit(_prove, *_sent(chunk)) for chunk in islice(waiting, ahead)}
    while running:
        finished, running = wait(running, return_when=FIRST_COMPLETED)
        for future in finished:
            index, arrays = future.result()
            running.update(pool.submit(_prove, *_sent(chunk)) for chunk in islice(waiting, 1))
            yield index, CellTubes.of(arrays)


def _sent(chunk: Chunk) -> tuple[int, dict[str, np.ndarray]]:
    """A chunk as arrays: tensors would be sent as handles of shared memory, of which a process may hold few."""
    return chunk.index, chunk.arrays()


def _start(prover: CellProver) -> None:
    global _prover
    be_a_worker()
    _prover = prover


def _prove(index: int, arrays: Mapping[str, np.ndarray]) -> tuple[int, dict[str, np.ndarray]]:
    assert _prover is not None, "the worker was not started"
    return index, _prover.prove(Chunk.of(index, arrays)).arrays()
