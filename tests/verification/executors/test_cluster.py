import json
import subprocess
import sys
import time
import warnings

import pytest

from sagemp_cli.errors import ConfigError, ResourceError
from sagemp_cli.verification.executors import Dask


@pytest.fixture
def cluster(tmp_path):
    """Address of a scheduler on loopback, and its two workers: three processes that are ended afterwards."""
    pytest.importorskip("distributed", reason="dask.distributed is not installed (pip install 'sagemp[dask]')")
    file, log, started = tmp_path / "scheduler.json", (tmp_path / "log").open("w"), []

    def start(module, *arguments):
        command = [sys.executable, "-m", f"distributed.cli.{module}", *arguments, "--no-dashboard"]
        started.append(subprocess.Popen(command, stdout=log, stderr=log, cwd=tmp_path))
        return started[-1]

    try:
        start("dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(file))
        until = time.monotonic() + 60
        while not (file.exists() and file.read_text().strip().endswith("}")):
            assert time.monotonic() < until and started[0].poll() is None, (tmp_path / "log").read_text()
            time.sleep(0.1)
        address = json.loads(file.read_text())["address"]
        options = ("--nthreads", "1", "--no-nanny", "--local-directory", str(tmp_path))
        workers = [start("dask_worker", address, *options) for _ in range(2)]
        yield address, workers
    finally:
        for process in reversed(started):
            process.kill()
            process.wait()
        log.close()


class KillWhen:
    """Progress that kills a worker after the first finished chunk."""

    def __init__(self, worker):
        self.worker = worker

    def task(self, description, total, done=0):
        return self

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return None

    def advance(self, steps=1, note=""):
        if self.worker.poll() is None:
            self.worker.kill()
            self.worker.wait()

    def say(self, text):
        pass


def test_a_worker_that_is_killed_in_the_middle_changes_nothing(small, same_bits, cluster):
    from distributed import Client

    address, workers = cluster
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the client's own libraries
        with Client(address, set_as_default=False, timeout=60) as client:
            client.wait_for_workers(2, timeout=60)
        found = small.verify([3, 3], executor=Dask(address), progress=KillWhen(workers[0]))
    assert workers[0].poll() is not None and workers[1].poll() is None
    same_bits(found, small.verify([3, 3]))


def test_a_scheduler_that_does_not_answer_is_one_clear_error(small):
    pytest.importorskip("distributed", reason="dask.distributed is not installed (pip install 'sagemp[dask]')")
    with (
        warnings.catch_warnings(),
        pytest.raises(ResourceError, match="executor.address: no Dask scheduler answers at tcp://127.0.0.1:9 "),
        Dask("tcp://127.0.0.1:9", timeout=1).opened(small.prover),
    ):
        pass


def test_without_dask_the_extra_is_named(small, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(
            ConfigError, match=r"executor=dask needs dask.distributed; install it with: pip install 'sagemp\[dask\]'"
        ),
        Dask("tcp://127.0.0.1:8786").opened(small.prover),
    ):
        pass


@pytest.mark.parametrize("address", ["", "here", "127.0.0.1:8786"])
def test_what_is_no_address_is_refused(address):
    with pytest.raises(ConfigError, match="executor.address must be that of a Dask scheduler such as tcp://"):
        Dask(address)
