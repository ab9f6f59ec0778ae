from __future__ import annotations

import multiprocessing
import os
from dataclasses import replace

import numpy as np
import pytest

from sagemp_cli.errors import ConfigError, ResourceError
from sagemp_cli.experts import plan_demonstrations, solve_problems


@pytest.fixture
def expert(expert):
    return replace(expert, longest_detour=1.0)  # one class per problem is enough here


def test_two_processes_give_the_same_demonstrations_as_none_and_lose_none(expert, starts):
    problems, variables = plan_demonstrations(starts, 6, seed=1), dict(os.environ)
    here = {d.problem.index: d for d in solve_problems(problems, expert, processes=0)}
    there = {d.problem.index: d for d in solve_problems(problems, expert, processes=2)}
    assert sorted(here) == sorted(there) == list(range(6))
    for i, demonstration in here.items():
        np.testing.assert_array_equal(demonstration.trajectory.controls, there[i].trajectory.controls)
        np.testing.assert_array_equal(demonstration.trajectory.states, there[i].trajectory.states)
    assert dict(os.environ) == variables


def test_a_resumed_run_solves_what_is_left_and_only_that(expert, starts):
    problems = plan_demonstrations(starts, 4, seed=1)
    whole = {d.problem.index: d for d in solve_problems(problems, expert, processes=0)}
    rest = {d.problem.index: d for d in solve_problems(problems, expert, processes=0, done={0, 2})}
    assert sorted(rest) == [1, 3]
    for i, demonstration in rest.items():
        np.testing.assert_array_equal(demonstration.trajectory.states, whole[i].trajectory.states)


def test_nothing_left_starts_no_process(expert, starts):
    assert list(solve_problems(plan_demonstrations(starts, 2, seed=1), expert, processes=2, done={0, 1})) == []


def test_closing_early_leaves_no_worker_behind(expert, starts):
    finished = solve_problems(plan_demonstrations(starts, 50, seed=1), expert, processes=1)
    assert next(finished).failure == ""
    finished.close()
    assert multiprocessing.active_children() == []


def test_a_worker_that_dies_is_an_error_for_people(expert, starts):
    finished = solve_problems(plan_demonstrations(starts, 50, seed=1), expert, processes=1)
    next(finished)
    multiprocessing.active_children()[0].kill()
    with pytest.raises(ResourceError, match="a worker process of the expert died .*; run again to resume"):
        list(finished)


def test_a_negative_number_of_processes_is_refused_at_once(expert, starts):
    with pytest.raises(ConfigError, match="processes must be zero or positive, found -1"):
        solve_problems(plan_demonstrations(starts, 2, seed=1), expert, processes=-1)
