"""Into how many parts a period is cut: as many as remainders ask for."""

import torch

from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.continuous.division import remainder_share
from sagemp_cli.reachability.continuous.observed import observed_ode
from sagemp_cli.reachability.continuous.reach import reach_continuously
from sagemp_cli.reachability.continuous.trial import suggested
from sagemp_cli.reachability.flow import Division
from sagemp_cli.sets import Box


def box(lower, upper):
    return Box(torch.tensor(lower, dtype=torch.float64), torch.tensor(upper, dtype=torch.float64))


def resting(x, u):
    """A pendulum, a state that nothing moves, and one that hardly moves and only through a product."""
    return torch.stack([x[..., 1], torch.sin(x[..., 0]) + u[..., 0], 0.0 * x[..., 2], 1e-6 * x[..., 0] * x[..., 1]], -1)


def push(x):
    return -2 * x[..., :1] - x[..., 1:2]


def test_states_that_rest_do_not_ask_for_more_parts():
    start = box([-0.1, -0.1, 0.0, 0.0], [0.1, 0.1, 0.0, 0.0])
    seen = observed_ode(resting, push, start, None, period=0.1, horizon=8)
    cells = Box(start.lower[None], start.upper[None])
    assert suggested(Affine(), seen.loop, cells, seen.disturbance, substeps=None, order=None) == Division(1, 2)
    found = reach_continuously(Affine(), seen.loop, cells, seen.disturbance, substeps=1, order=2)
    assert 0 < float(remainder_share(found)) < 0.3
