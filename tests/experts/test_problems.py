from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from sagemp_cli.errors import ConfigError
from sagemp_cli.experts import PlannedDemonstration, Weights, plan_demonstrations, solve_problem
from sagemp_cli.scenes import Block


def test_problem_i_is_the_same_however_many_are_planned(starts):
    few, many = plan_demonstrations(starts, 3, seed=7), plan_demonstrations(starts, 12, seed=7)
    for a, b in zip(few, many, strict=False):
        assert (a.index, a.seed) == (b.index, b.seed)
        np.testing.assert_array_equal(a.start, b.start)
    assert len({tuple(p.start) for p in many}) == 12
    assert not np.array_equal(few[0].start, plan_demonstrations(starts, 1, seed=8)[0].start)


def test_starts_lie_in_their_box(starts):
    points = torch.from_numpy(np.stack([p.start for p in plan_demonstrations(starts, 200, seed=0)]))
    assert bool(starts.contains(points).all())
    assert bool(((points.amax(0) - points.amin(0)) > 0.9 * starts.width).all())


def test_both_sides_of_the_obstacles_are_demonstrated(expert, starts):
    found = [solve_problem(p, replace(expert, temperature=1.0)) for p in plan_demonstrations(starts, 10, seed=0)]
    assert [d.failure for d in found] == [""] * 10
    sides = np.array([d.trajectory.sides for d in found])
    assert all(set(column) == {0, 1} for column in sides.T)


def test_temperature_zero_keeps_the_cheapest_class(expert, starts):
    problem = plan_demonstrations(starts, 1, seed=3)[0]
    cheapest = solve_problem(problem, expert)
    assert cheapest.classes_found >= 2
    drawn = [solve_problem(replace(problem, index=i), replace(expert, temperature=np.inf)) for i in range(5)]
    assert min(d.trajectory.cost for d in drawn) >= cheapest.trajectory.cost - 1e-9
    assert len({d.trajectory.sides for d in drawn}) >= 2


def test_a_start_inside_an_obstacle_gives_a_reason_and_no_trajectory(expert):
    found = solve_problem(PlannedDemonstration(0, 0, np.array([2.0, -0.3, 0.0, 1.0])), expert)
    assert found.trajectory is None
    assert found.failure == "the start lies inside obstacle 'first disc' (0.5 m deep)"


def test_a_wall_across_the_workspace_gives_a_reason_and_no_trajectory(expert, slalom):
    walled = replace(expert, scene=replace(slalom, obstacles=(Block((3.0, -3.0), (4.0, 3.0), "wall"),)))
    found = solve_problem(PlannedDemonstration(0, 0, np.array([0.0, 0.0, 0.0, 1.0])), walled)
    assert found.trajectory is None
    assert found.failure == "no way between the obstacles: every via point beside them is blocked"


def test_classes_that_all_fail_give_the_reason_of_the_shortest(expert):
    hurried = replace(expert, horizon=8, max_iterations=30)
    found = solve_problem(PlannedDemonstration(0, 0, np.array([0.0, 0.0, 0.0, 1.0])), hurried)
    assert found.trajectory is None and found.classes_found == 0
    assert found.failure.startswith(f"none of {found.classes_tried} classes is feasible; the shortest: ")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"temperature": -1.0}, "temperature must be zero or positive, found -1.0"),
        ({"margin": -0.1}, "margin and workspace_margin must not be negative, found -0.1"),
        ({"longest_detour": 0.9}, "longest_detour must be at least 1, found 0.9"),
        ({"weights": Weights([1.0, 1.0], [1.0], [1.0] * 4)}, "weights.smoothness needs 2 numbers, found 1"),
    ],
)
def test_an_expert_that_cannot_be_is_refused_before_any_work(expert, change, message):
    with pytest.raises(ConfigError, match=message):
        replace(expert, **change)


def test_a_count_or_seed_that_cannot_be_is_refused(starts):
    with pytest.raises(ConfigError, match="count of demonstrations must be at least 1, found 0"):
        plan_demonstrations(starts, 0, seed=0)
    with pytest.raises(ConfigError, match="seed must not be negative, found -1"):
        plan_demonstrations(starts, 1, seed=-1)
