import multiprocessing
import os
import signal

import numpy as np
import pytest
import torch

from sagemp_cli.config.binding import build
from sagemp_cli.errors import ConfigError, ResourceError
from sagemp_cli.sets import Box
from sagemp_cli.verification.cells import CellTubes, Chunk
from sagemp_cli.verification.executors import Processes, Serial
from sagemp_cli.verification.executors import processes as module


class Kept:
    """Pieces in memory, as arrays; raises Ctrl-C once so many were saved."""

    def __init__(self, stop=None):
        self.arrays, self.stop, self.loaded = {}, stop, []

    @property
    def finished(self):
        return set(self.arrays)

    def load(self, index):
        self.loaded.append(index)
        return self.arrays[index]

    def save(self, index, arrays):
        assert index not in self.arrays
        self.arrays[index] = {name: np.copy(a) for name, a in arrays.items()}
        if len(self.arrays) == self.stop:
            raise KeyboardInterrupt


def test_worker_processes_give_the_same_bits_and_end(small, same_bits):
    here = small.verify([2, 2])
    assert len(here.cell_reference) == 24
    same_bits(small.verify([2, 2], executor=Processes(workers=2, least=0)), here)
    assert multiprocessing.active_children() == []


def test_few_cells_start_no_process(small, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("a process was started")

    monkeypatch.setattr(module, "ProcessPoolExecutor", refuse)
    small.verify([2, 2], executor=Processes(workers=2, least=25))
    small.verify([2, 2], executor=Processes(workers=1, least=0))


def test_a_worker_that_dies_is_one_clear_error(small):
    chunks = [
        Chunk(
            i,
            torch.zeros(1, dtype=torch.int64),
            torch.zeros(1, 11, 4).double(),
            Box(torch.zeros(1, 4), torch.ones(1, 4)),
        )
        for i in range(500)
    ]
    with (
        pytest.raises(ResourceError, match="a worker process died .*run again to go on, with fewer executor.workers"),
        Processes(workers=1 + 1, least=0).opened(small.prover) as run,
    ):
        for n, _ in enumerate(run(chunks)):
            if n == 0:
                for child in multiprocessing.active_children():
                    os.kill(child.pid, signal.SIGKILL)


@pytest.mark.parametrize("counts", [[2, 2], None])
def test_a_run_that_dies_goes_on_from_its_finished_chunks(small, same_bits, counts):
    end = float(small.verify([1, 1]).tube.upper[:, -1, 0].max()) - 0.01  # less than what the disturbance moves
    whole = small.verify(counts, end, budget=6)
    assert whole.cell_reference.bincount().min() > 3  # more chunks than the interrupted run
    kept = Kept(stop=3)
    with pytest.raises(KeyboardInterrupt):
        small.verify(counts, end, budget=6, pieces=kept)
    before, kept.stop = set(kept.arrays), None
    assert len(before) == 3
    resumed = small.verify(counts, end, budget=6, pieces=kept)
    same_bits(resumed, whole)
    assert set(kept.loaded) == before and len(kept.arrays) > 3  # saving one twice would have failed
    assert bool((resumed.seconds > 0).all())


def test_threads_of_the_caller_change_no_bit_and_are_given_back(small, same_bits):
    one = small.verify([2, 1])
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        same_bits(small.verify([2, 1], executor=Serial()), one)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_tubes_come_back_from_arrays_as_they_went(small):
    chunk = Chunk(0, torch.tensor([3]), torch.zeros(1, 11, 4).double(), Box(torch.zeros(1, 4), torch.ones(1, 4)))
    tubes = small.prover.prove(chunk)
    again = CellTubes.of(tubes.arrays())
    assert again.recording.operations == tubes.recording.operations
    assert again.recording.widths == tubes.recording.widths
    assert all(np.array_equal(a, again.arrays()[name]) for name, a in tubes.arrays().items())
    assert all(a.dtype.kind in "fiuU" for a in tubes.arrays().values())  # nothing that needs a pickle


@pytest.mark.parametrize(
    ("options", "message"), [({"workers": 0}, "executor.workers"), ({"least": -1}, "executor.least")]
)
def test_wrong_numbers_are_refused(options, message):
    with pytest.raises(ConfigError, match=message):
        build({"name": "processes"} | options, "executor")
