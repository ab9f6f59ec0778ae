import math

import numpy as np
import pytest

from sagemp_cli.errors import UsageError
from sagemp_cli.library import draws_needed, imitation_probability


@pytest.mark.parametrize(("p_samp", "alpha"), [(0.3, 0.1), (0.05, 0.2), (0.02, 0.05)])
def test_simulated_libraries_contain_a_close_reference_at_least_as_often_as_the_theorem_says(p_samp, alpha):
    # A planner whose plans are numbers in [0, 1); the plan at run time has a ball of probability p_samp.
    draws, libraries = draws_needed(p_samp, alpha), 20_000
    rng = np.random.default_rng(0)
    hit = (rng.random((libraries, draws)) < p_samp).any(axis=1).mean()
    exact = 1 - (1 - p_samp) ** draws
    assert exact >= imitation_probability(p_samp, draws) >= 1 - alpha
    deviation = 4 * math.sqrt(exact * (1 - exact) / libraries)
    assert exact - deviation <= hit <= exact + deviation


def test_one_draw_fewer_does_not_meet_the_bound():
    for p_samp, alpha in [(0.3, 0.1), (0.01, 0.01), (1.0, 0.5)]:
        draws = draws_needed(p_samp, alpha)
        assert imitation_probability(p_samp, draws) >= 1 - alpha > imitation_probability(p_samp, draws - 1)


def test_probabilities_outside_their_range_are_refused():
    with pytest.raises(UsageError, match=r"p_samp must lie in \(0, 1\], found 0"):
        draws_needed(0, 0.1)
    with pytest.raises(UsageError, match=r"alpha must lie in \(0, 1\), found 1"):
        draws_needed(0.5, 1)
    with pytest.raises(UsageError, match="draws must not be negative"):
        imitation_probability(0.5, -1)
