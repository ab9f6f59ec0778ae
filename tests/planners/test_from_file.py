"""A file of trajectories as a planner."""

import json
import math

import numpy as np
import pytest
import torch

from sagemp_cli.dynamics.unicycle import Unicycle
from sagemp_cli.errors import ArtifactError, ConfigError
from sagemp_cli.planners import FromFile, Planner
from sagemp_cli.scenes.scene import Scene
from sagemp_cli.sets import Box

SCENE = Scene(Box(torch.zeros(2), torch.ones(2)), (), Box(torch.zeros(4), torch.ones(4)))
LIMITS = {"control_lower": [-9, -9], "control_upper": [9, 9], "state_lower": [-9] * 4, "state_upper": [9] * 4}
OPTIONS = {
    "state_dim": 4,
    "horizon": 10,
    "dt": 0.1,
    "state_names": ["px", "py", "theta", "v"],
    "robot": Unicycle(dt=0.1, **LIMITS),
}


def sample(planner, start, count):
    start = torch.tensor(start, dtype=torch.float64)
    return planner.sample(start, SCENE.goal, scene=SCENE, count=count, generator=torch.Generator())


def lines(tmp_path, *heights, rows=11):
    """Straight trajectories at 1 m/s along x at the given heights, with all states."""
    plans = np.zeros((len(heights), rows, 4))
    plans[..., 0], plans[..., 1], plans[..., 3] = np.linspace(0, 1, rows), np.array(heights)[:, None], 1.0
    np.savez(tmp_path / "plans.npz", references=plans)
    return FromFile(path=str(tmp_path / "plans.npz"), **OPTIONS), plans


def test_the_closest_trajectories_come_first_and_come_again(tmp_path):
    planner, plans = lines(tmp_path, 0.0, 3.0, 1.0)
    references = sample(planner, [0.0, 2.8, 0.0, 1.0], 5)
    assert references.dtype == torch.float64 and isinstance(planner, Planner)
    np.testing.assert_array_equal(references.numpy(), plans[[1, 2, 0, 1, 2]])
    each = sample(planner, [[0.0, 0.1, 0.0, 1.0], [0.0, 1.2, 0.0, 1.0], [0.0, 9.0, 0.0, 1.0]], 3)
    np.testing.assert_array_equal(each.numpy(), plans[[0, 2, 1]])


def test_trajectories_as_long_as_the_horizon_need_no_times_and_are_kept_exactly(tmp_path):
    planner, plans = lines(tmp_path, 0.1)
    np.testing.assert_array_equal(planner.trajectories.numpy(), plans)
    assert planner.notes == []


def test_others_are_resampled_linearly_in_time(tmp_path):
    (tmp_path / "plan.csv").write_text("t,px,py,theta,v\n5.0,0,0,0,1\n5.25,1,0,0,1\n6.0,1,3,0,2\n")
    planner = FromFile(path=str(tmp_path / "plan.csv"), **OPTIONS)
    (found,) = planner.trajectories
    np.testing.assert_allclose(found[:, 0], np.minimum(4 * 0.1 * np.arange(11), 1))
    np.testing.assert_allclose(found[[2, 5, 10], 1], [0, 1, 3])
    np.testing.assert_allclose(found[:, 3], np.interp(0.1 * np.arange(11), [0.25, 1], [1, 2]))


def test_angles_are_interpolated_the_short_way_round(tmp_path):
    (tmp_path / "plan.csv").write_text("t,px,py,theta,v\n0,0,0,3.0,1\n1,1,0,-3.0,1\n")
    heading = FromFile(path=str(tmp_path / "plan.csv"), **OPTIONS).trajectories[0, :, 2]
    np.testing.assert_allclose(heading, np.linspace(3.0, 2 * math.pi - 3.0, 11))


def test_angles_are_moved_by_whole_turns_next_to_the_start(tmp_path):
    planner, plans = lines(tmp_path, 0.0)
    turned = sample(planner, [0.0, 0.0, 2 * math.pi + 0.3, 1.0], 1)[0]
    np.testing.assert_allclose(turned[:, 2], 2 * math.pi)
    np.testing.assert_array_equal(np.delete(turned.numpy(), 2, axis=1), np.delete(plans[0], 2, axis=1))


def test_missing_states_are_filled_in_and_that_is_said(tmp_path):
    (tmp_path / "plans.csv").write_text("trajectory,t,px,py\na,0,0,0\na,1,2,0\nb,0,0,0\nb,0.5,0,1\n")
    planner = FromFile(path=str(tmp_path / "plans.csv"), **OPTIONS)
    first, second = planner.trajectories
    np.testing.assert_allclose(first[:, 2:], [[0, 2]] * 11)
    np.testing.assert_allclose(second[:5, 2:], [[math.pi / 2, 2]] * 5)
    np.testing.assert_allclose(second[5:, 1], 1)  # it has ended
    assert planner.notes == [
        "trajectory b ends after 0.5 s and keeps its last row until 1 s",
        "v: speed of the position's differences",
        "theta: direction of the position's differences",
    ]


def test_a_planner_is_rebuilt_without_the_file(tmp_path):
    planner, _ = lines(tmp_path, 0.0, 1.0)
    planner.notes.append("a note")
    (tmp_path / "plans.npz").unlink()
    other = FromFile(**json.loads(json.dumps(planner.arguments)))
    other.load_state_dict(planner.state_dict())
    assert torch.equal(sample(planner, [0.0] * 4, 2), sample(other, [0.0] * 4, 2))
    assert other.notes == ["a note"] and other.source is None


def test_trajectories_that_do_not_fit_the_horizon_are_one_line(tmp_path):
    with pytest.raises(ArtifactError, match=r"has 8 rows and no time 't'; .* must be horizon \+ 1 = 11"):
        lines(tmp_path, 0.0, rows=8)
    path = tmp_path / "plan.csv"
    path.write_text("t,px,py\n0,0,0\n2.5,1,1\n")
    with pytest.raises(ArtifactError, match="lasts 2.5 s, but horizon is 10 steps of 0.1 s, 1 s; set horizon=25"):
        FromFile(path=str(path), **OPTIONS)
    path.write_text("t,px,py\n")
    with pytest.raises(ArtifactError, match="holds no trajectory"):
        FromFile(path=str(path), **OPTIONS)


@pytest.mark.parametrize(("factor", "unit"), [(1e9, "nanoseconds"), (1e6, "microseconds"), (1e3, "milliseconds")])
def test_times_in_another_unit_are_not_answered_with_a_horizon_of_millions(tmp_path, factor, unit):
    path = tmp_path / "plan.csv"
    path.write_text(f"t,px,py\n{1.7e9 * factor:.0f},0,0\n{(1.7e9 + 1) * factor:.0f},1,1\n")
    with pytest.raises(ArtifactError, match=f"times are read in seconds, these look like {unit}; divide them") as found:
        FromFile(path=str(path), **OPTIONS)
    assert "set horizon" not in str(found.value)


def test_a_file_must_be_named():
    with pytest.raises(ConfigError, match="planner.path must name a file of trajectories, e.g. planner.path=plans.csv"):
        FromFile(**OPTIONS)
