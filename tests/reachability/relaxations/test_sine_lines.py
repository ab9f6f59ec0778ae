"""Lines beside sines: of all that are above or below, those that leave least area, also around an inflection."""

import numpy as np
import pytest
import torch

from sagemp_cli.reachability.relaxations.sine import cosine_lines, sine_lines

SLOPES = np.linspace(-1.0, 1.0, 2001)[:, None]


@pytest.mark.parametrize(("name", "lines"), [("sin", sine_lines), ("cos", cosine_lines)])
@pytest.mark.parametrize(("low", "high"), [(-1.0, 2.0), (-2.0, 0.7), (-0.5, 2.9), (2.0, 4.5), (0.3, 1.2), (1.0, 2.2)])
def test_both_lines_are_as_near_at_the_middle_as_any(name, lines, low, high):
    x, middle = np.linspace(low, high, 1001), 0.5 * (low + high)
    excess = getattr(np, name)(x) - SLOPES * x
    best_above = (excess.max(1) + SLOPES[:, 0] * middle).min()
    best_below = (excess.min(1) + SLOPES[:, 0] * middle).max()
    ends = (torch.tensor([v], dtype=torch.float64) for v in (low, high))
    below, least, above, most = (float(part) for part in lines(*ends))
    gap = best_above - best_below
    assert abs(above * middle + most - best_above) < 0.01 * gap
    assert abs(below * middle + least - best_below) < 0.01 * gap
