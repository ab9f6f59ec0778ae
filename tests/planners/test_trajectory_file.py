"""Files of trajectories: what is read, and every kind of file that is refused."""

import time

import h5py
import numpy as np
import pytest

from sagemp_cli.errors import ArtifactError
from sagemp_cli.planners.trajectory_file import read_trajectories

NAMES = ("px", "py", "theta", "v")
CSV = "t,px,py\n0,0,1\n0.5,1,1\n1.5,2,0\n"


def save(path, **arrays):
    if path.suffix == ".npz":
        np.savez(path, **arrays)
    else:
        with h5py.File(path, "w") as file:
            for name, array in arrays.items():
                file[name] = array
    return path


def written(path, text):
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", ["plans.h5", "plans.hdf5", "plans.npz"])
def test_all_states_at_once_are_read_as_they_are(tmp_path, name):
    plans = np.random.default_rng(0).normal(size=(3, 6, 4))
    found = read_trajectories(save(tmp_path / name, references=plans, t=np.arange(6.0)), state_names=NAMES)
    assert [f.name for f in found] == ["trajectory 0", "trajectory 1", "trajectory 2"]
    for i, trajectory in enumerate(found):
        np.testing.assert_array_equal(np.stack([trajectory.states[n] for n in NAMES], axis=-1), plans[i])
        np.testing.assert_array_equal(trajectory.time, np.arange(6.0))
    (single,) = read_trajectories(save(tmp_path / name, references=plans[0]), state_names=NAMES)
    np.testing.assert_array_equal(single.states["v"], plans[0, :, 3])
    assert single.time is None and single.rows == 6


@pytest.mark.parametrize("name", ["plans.h5", "plans.npz"])
def test_some_states_by_name_are_read_with_times_of_their_own(tmp_path, name):
    times = np.array([[0.0, 1.0, 2.0], [5.0, 5.5, 7.0]])
    path = save(tmp_path / name, px=np.ones((2, 3)), py=np.zeros((2, 3), dtype=np.int32), t=times)
    first, second = read_trajectories(path, state_names=NAMES)
    assert set(first.states) == {"px", "py"}
    np.testing.assert_array_equal(second.time, times[1])
    (alone,) = read_trajectories(save(tmp_path / name, px=np.ones(3), py=np.ones(3)), state_names=NAMES)
    assert alone.rows == 3


def test_a_csv_is_read_by_its_header(tmp_path):
    (found,) = read_trajectories(written(tmp_path / "plan.csv", CSV), state_names=NAMES)
    np.testing.assert_array_equal(found.time, [0, 0.5, 1.5])
    np.testing.assert_array_equal(found.states["py"], [1, 1, 0])


def test_rows_of_a_csv_belong_to_the_trajectory_that_they_name(tmp_path):
    text = "\ufefftrajectory, px ,py\nleft,0,0\nright,0,5\n\nleft,1,2\nright,3,4\nright,6,7\n"
    left, right = read_trajectories(written(tmp_path / "plans.csv", text), state_names=NAMES)
    assert (left.name, left.rows, right.name, right.rows) == ("trajectory left", 2, "trajectory right", 3)
    np.testing.assert_array_equal(right.states["px"], [0, 3, 6])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty; a header with t and state names is expected"),
        ("t,px,py\n0,1\n", "line 2 has 2 values, the header has 3"),
        ("t,px,py\n0,1,2\n1,one,3\n", "line 3, column 'px': 'one' is no number"),
        ("t,px,py\n0,1,nan\n1,2,3\n", "trajectory has py = nan in row 0; numbers must be finite"),
        ("t,px,py\n0,1,2\n1,inf,3\n", "trajectory has px = inf in row 1; numbers must be finite"),
        ("t,px,py\n0,1,2\n", "trajectory has 1 rows; at least two are needed"),
        ("t,px,py\n0,1,2\n1,1,2\n1,2,3\n", "trajectory: times must increase, but row 2 has 1.0 after 1.0"),
        (
            "t,px,py\n1732780000.25,1,2\n1732780000.125,2,3\n",
            "times must increase, but row 1 has 1732780000.125 after 1732780000.25",
        ),
        ("t,px,py,px\n0,1,2,3\n", "has two columns 'px'"),
        (
            "t,px,pi\n0,1,2\n1,2,3\n",
            r"'pi' is not recognised \(did you mean 'p.'\?\); recognised: px, py, theta, v, t",
        ),
        ("t\n0\n1\n", "holds none of the states px, py, theta, v"),
    ],
)
def test_a_bad_csv_is_one_line_with_the_file(tmp_path, text, message):
    path = written(tmp_path / "plan.csv", text)
    with pytest.raises(ArtifactError, match=message) as caught:
        read_trajectories(path, state_names=NAMES)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["plans.h5", "plans.npz"])
@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"references": np.zeros((2, 5, 3))}, r"'references' must have shape \(count, rows, 4\) for the states px, py"),
        ({"references": np.zeros((2, 5, 4)), "v": np.zeros((2, 5))}, "with all states, so 'v' is one too many"),
        ({"px": np.zeros(5), "py": np.zeros(4)}, r"'py' has shape \(1, 4\); all states need .* like \(1, 5\)"),
        (
            {"px": np.zeros(5), "py": np.zeros(5), "t": np.zeros(4)},
            r"'t' must have shape \(5,\) or \(1, 5\), found \(4,\)",
        ),
        ({"px": np.zeros(5), "pz": np.zeros(5)}, r"'pz' is not recognised \(did you mean 'p.'\?\)"),
        ({"px": np.zeros(5), "py": np.full(5, 1j)}, "'py' must hold real numbers, found type complex128"),
        ({"references": np.full((1, 5, 4), np.nan)}, "trajectory 0 has px = nan in row 0"),
        ({"t": np.zeros(4)}, "holds none of the states"),
    ],
)
def test_bad_arrays_are_one_line_with_the_file(tmp_path, name, arrays, message):
    path = save(tmp_path / name, **arrays)
    with pytest.raises(ArtifactError, match=message) as caught:
        read_trajectories(path, state_names=NAMES)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["plan.csv", "plan.h5", "plan.npz"])
def test_what_is_no_such_file_is_one_line(tmp_path, name):
    path = tmp_path / name
    with pytest.raises(ArtifactError, match="no such file"):
        read_trajectories(path, state_names=NAMES)
    path.write_bytes(b"PK\x03\x04\xff\xfe neither")
    with pytest.raises(ArtifactError, match="cannot be read") as caught:
        read_trajectories(path, state_names=NAMES)
    assert "\n" not in str(caught.value)


def test_other_kinds_of_files_and_groups_and_pickles_are_refused(tmp_path):
    with pytest.raises(ArtifactError, match=r"must be in HDF5 \(.h5, .hdf5\), NPZ \(.npz\) or CSV \(.csv\)"):
        read_trajectories(tmp_path / "plan.txt", state_names=NAMES)
    with h5py.File(tmp_path / "plan.h5", "w") as file:
        file.create_group("px")
    with pytest.raises(ArtifactError, match="'px' is a group; a dataset of numbers is expected there"):
        read_trajectories(tmp_path / "plan.h5", state_names=NAMES)
    np.savez(tmp_path / "plan.npz", px=np.array([{"any": "object"}], dtype=object))
    with pytest.raises(ArtifactError, match="cannot be read .*allow_pickle=False"):
        read_trajectories(tmp_path / "plan.npz", state_names=NAMES)


@pytest.mark.parametrize(
    ("header", "rows", "message"),
    [
        ("t,px", [(0, 0), (1e308, 1)], r"t = 1e\+308 in row 1; at most 1e\+20 s; t is in seconds is allowed"),
        ("t,px", [(0, 1e300), (1, 1)], r"px = 1e\+300 in row 0; at most 1e\+09 is allowed"),
        (",".join(f"c{i}" for i in range(200_000)), [(0, 1)], "'c0' is not recognised"),
        (",".join(["px"] * 200_000), [(0, 1)], "has two columns 'px'"),
    ],
)
def test_numbers_and_tables_beyond_all_measure_are_one_line_at_once(tmp_path, header, rows, message):
    path = tmp_path / "plan.csv"
    path.write_text("\n".join([header, *(f"{a},{b}" for a, b in rows)]))
    began = time.monotonic()
    with pytest.raises(ArtifactError, match=message):
        read_trajectories(path, state_names=NAMES)
    assert time.monotonic() - began < 5


def test_a_csv_that_is_too_large_is_refused_before_it_is_read(tmp_path):
    with (tmp_path / "plan.csv").open("wb") as file:
        file.truncate(2**26 + 1)
    with pytest.raises(ArtifactError, match="a CSV may have 64 MiB, HDF5 and NPZ hold more"):
        read_trajectories(tmp_path / "plan.csv", state_names=NAMES)
