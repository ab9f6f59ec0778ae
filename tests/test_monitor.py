"""The runtime monitor: silent inside the tube, an alarm at the first departure, and never an exception."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from sagemp_cli import monitor as module
from sagemp_cli.execution.runner import inside_tube
from sagemp_cli.monitor import Cause, Monitor
from sagemp_cli.sets import Box, Tube
from sagemp_cli.stages.export_monitor import export_monitor
from sagemp_cli.storage import Certificate, Library, Rollouts, read_artifact

NAMES = ("px", "heading")


def made(**options):
    """Two cells side by side, [0, 1] and [1, 2] in px, whose tubes move by one a step and overlap."""
    low = np.array([[[k, -1.0] for k in range(4)], [[k + 0.9, -1.0] for k in range(4)]])
    high = np.array([[[k + 1.1, 1.0] for k in range(4)], [[k + 2.0, 1.0] for k in range(4)]])
    return Monitor(low, high, low[:, 0], high[:, 0], NAMES, **options)


def seen(monitor, states, times=None):
    """The first alarm of a run."""
    for k, x in enumerate(states):
        monitor.see(x, time=None if times is None else times[k])
    return monitor.alarm


def test_a_run_in_its_tube_raises_no_alarm():
    assert seen(made(), [[0.5 + k, 0.0] for k in range(4)]) is None


def test_the_first_departure_is_named_with_step_coordinate_and_size_and_stays():
    monitor = made()
    alarm = seen(monitor, [[0.5, 0.0], [1.5, 0.0], [2.5, 1.25], [99.0, 99.0]])
    assert (alarm.cause, alarm.step, alarm.coordinate, alarm.size) == (Cause.OUTSIDE, 2, "heading", 0.25)
    assert str(alarm) == "step 2: outside of the tube: heading is 1.25, certified is -1 to 1"
    assert monitor.see([3.5, 0.0]) is alarm


def test_a_start_in_one_cell_has_that_cells_tube_and_one_on_a_face_both():
    assert seen(made(), [[0.5, 0.0], [2.5, 0.0]]).step == 1  # the other cell's tube would hold it
    assert seen(made(), [[1.5, 0.0], [2.5, 0.0]]) is None
    assert seen(made(), [[1.0, 0.0], [2.5, 0.0]]).step == 1
    assert seen(made(), [[1.0, 0.0], [2.0, 0.0]]) is None


def test_a_start_beside_a_face_by_rounding_has_the_tubes_there():
    """Computed, not measured: a corner of X_I that rounding put outside of all cells."""
    assert seen(made(), [[0.5 + k, -1.0 - 1e-12] for k in range(4)]) is None
    assert seen(made(), [[2.0 + 1e-12, 0.0], [1.5, 0.0]]).step == 1


def test_a_start_between_the_cells_is_an_alarm_at_once():
    low, high = np.zeros((2, 2, 1)), np.ones((2, 2, 1))
    apart = Monitor(low, high, np.array([[0.0], [0.75]]), np.array([[0.25], [1.0]]), ("x",))
    assert seen(apart, [[0.5]]).cause is Cause.START


def test_a_start_outside_of_every_cell_is_an_alarm_at_once():
    alarm = seen(made(), [[2.5, 0.0]])
    assert (alarm.cause, alarm.step, alarm.coordinate, alarm.size) == (Cause.START, 0, "px", 0.5)


@pytest.mark.parametrize(
    "state",
    [[0.5], [0.5, 0.0, 0.0], [[0.5, 0.0]], [0.5, math.nan], [math.inf, 0.0], None, "0.5", ["a", "b"], [None, 0.0],
     {}, [0.5, 1j], [True, False]],
    ids=str,
)  # fmt: skip
@pytest.mark.parametrize("step", [0, 1])
def test_what_is_no_state_is_an_alarm_not_silence(state, step):
    monitor = made()
    assert seen(monitor, [[0.5 + k, 0.0] for k in range(step)]) is None
    alarm = monitor.see(state)
    assert (alarm.cause, alarm.step) == (Cause.NUMBERS, step)


class Hostile:
    def __array__(self, *_, **__):
        raise RuntimeError("no")


def test_what_raises_when_it_is_read_is_an_alarm():
    assert made().see(Hostile()).cause is Cause.NUMBERS


def test_a_state_after_the_last_is_an_alarm():
    assert seen(made(), [[0.5 + k, 0.0] for k in range(5)]).cause is Cause.END


@pytest.mark.parametrize(
    ("times", "text"),
    [
        ([5.0, 5.1, 5.2, 5.4], "step 3: not at its time: measured 0.1 s too late"),
        ([5.0, 5.1, 5.1, 5.3], "step 2: not at its time: measured 0.1 s too early"),
        ([5.0, 4.1, 5.2, 5.3], "step 1: not at its time: measured 1 s too early"),
        ([5.0, math.nan, 5.2, 5.3], "step 1: not at its time: nan is no time"),
        ([5.0, "later", 5.2, 5.3], "step 1: not at its time: 'later' is no time"),
    ],
    ids=["late", "stood still", "backwards", "nan", "text"],
)
def test_a_clock_that_jumps_is_an_alarm(times, text):
    assert str(seen(made(dt=0.1), [[0.5 + k, 0.0] for k in range(4)], times)) == text


def test_jitter_is_allowed_where_it_is_said_and_large_times_are_exact_enough():
    states = [[0.5 + k, 0.0] for k in range(4)]
    assert seen(made(dt=0.1, jitter=0.02), states, [5.0, 5.11, 5.19, 5.3]) is None
    assert seen(made(dt=0.1, jitter=0.02), states, [5.0, 5.13, 5.2, 5.3]).step == 1
    assert seen(made(dt=0.1), states, [1.7e9 + 0.1 * k for k in range(4)]) is None


def test_an_error_of_the_measurement_widens_the_tube_by_as_much():
    assert seen(made(error=[0.0, 0.3]), [[0.5, 0.0], [1.5, 1.25]]) is None
    assert seen(made(error=[0.0, 0.2]), [[0.5, 0.0], [1.5, 1.25]]).size == pytest.approx(0.05)
    assert seen(made(error=0.1), [[0.95, 0.0], [3.0, 0.0]]) is None  # it may have started in the other cell


@pytest.mark.parametrize("options", [{"error": -1.0}, {"jitter": math.nan}, {"dt": 0.0}, {"error": math.nan}], ids=str)
def test_options_that_mean_nothing_are_refused_before_the_run(options):
    with pytest.raises(ValueError, match="must not be negative"):
        made(**options)


def test_the_monitor_and_execute_agree_on_every_rollout(toy_folder, tmp_path):
    library = read_artifact(toy_folder / "library.h5", Library).record
    rollouts = read_artifact(toy_folder / "rollouts.h5", Rollouts).record
    export_monitor(toy_folder / "library.h5", tmp_path / "monitor.npz")
    rng, answers = np.random.default_rng(0), set()
    for states, query in zip(rollouts.states, rollouts.query, strict=True):
        reference = int(rollouts.chosen[query])
        for shift in (0.0, 0.02, 0.5):
            moved = states + shift * rng.normal(size=states.shape) * (np.arange(len(states)) > 0)[:, None]
            alarm = seen(Monitor.load(tmp_path / "monitor.npz", reference=reference), moved)
            own = library.tubes.cell_reference == reference
            cells = Box(*(torch.from_numpy(v[own]) for v in (library.tubes.cell_lower, library.tubes.cell_upper)))
            tubes = Tube(*(torch.from_numpy(v[own]) for v in (library.tubes.tube_lower, library.tubes.tube_upper)))
            inside = bool(inside_tube(torch.from_numpy(moved)[None], cells, tubes)[0])
            assert inside == (alarm is None)
            answers.add(inside)
    assert answers == {True, False}


def test_the_exported_module_needs_only_numpy(toy_folder, tmp_path):
    count, copied = export_monitor(toy_folder / "certificate.h5", tmp_path / "monitor.npz")
    record = read_artifact(toy_folder / "certificate.h5", Certificate).record
    assert count == 1 and copied.read_bytes() == Path(module.__file__).read_bytes()
    start = record.tubes.start_lower[0].tolist()
    code = f"""
import sys
class Nothing:
    def find_spec(self, name, *_):
        if name.split('.')[0] in ('torch', 'sagemp_cli', 'scipy', 'h5py', 'matplotlib'):
            raise ImportError(name)
sys.meta_path.insert(0, Nothing())
from monitor import Monitor
watching = Monitor.load("monitor.npz")
print(watching.see({start}), watching.see([0.0]).cause.name, watching.horizon)
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, env={})
    assert done.stdout.split() == ["None", "NUMBERS", str(record.tubes.tube_lower.shape[1] - 1)], done.stderr


def test_a_file_that_is_no_export_is_refused(tmp_path, toy_folder):
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(ValueError, match="not a file of 'sagemp export monitor'"):
        Monitor.load(tmp_path / "other.npz")
    export_monitor(toy_folder / "certificate.h5", tmp_path / "monitor.npz")
    with pytest.raises(ValueError, match="has the references 0 to 0, not 7"):
        Monitor.load(tmp_path / "monitor.npz", reference=7)
