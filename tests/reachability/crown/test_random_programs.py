"""Random programs with every operation that is written in several ways: no rollout leaves a tube."""

import pytest
from random_programs import escaped, random_problem, worst_rollouts

from sagemp_cli.reachability.crown.best import Best


@pytest.mark.parametrize("seed", [100, 101, 102, 105, 107, 108, 109, 110])
def test_a_random_program_stays_in_the_tube_of_best(seed):
    loop, start, disturbance = random_problem(seed)
    states = worst_rollouts(loop, start, disturbance, count=300, rounds=4)
    assert escaped(Best().propagate(loop, start, disturbance), states) == 0
