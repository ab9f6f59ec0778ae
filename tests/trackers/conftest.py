"""A small loop on which training takes seconds: a unicycle that follows two gentle curves."""

from __future__ import annotations

import pytest
import torch

from sagemp_cli.dynamics import Unicycle
from sagemp_cli.sets import Box
from sagemp_cli.trackers import Tracker

HORIZON = 12


@pytest.fixture
def unicycle():
    return Unicycle(
        dt=0.1,
        control_lower=[-2.0, -2.0],
        control_upper=[2.0, 2.0],
        state_lower=[-5.0, -5.0, -2.0, -1.0],
        state_upper=[5.0, 5.0, 2.0, 3.0],
    )


@pytest.fixture
def references(unicycle):
    """``(2, K+1, 4)``, rollouts of constant controls."""
    x = torch.tensor([[0.0, 0.0, 0.0, 1.0]] * 2, dtype=torch.float64)
    u = torch.tensor([[0.3, 0.0], [-0.2, 0.1]], dtype=torch.float64)
    states = [x]
    for _ in range(HORIZON):
        states.append(unicycle.step(states[-1], u, torch.zeros_like(x)))
    return torch.stack(states, dim=1)


@pytest.fixture
def start():
    return Box.around([0.0, 0.0, 0.0, 1.0], [0.2, 0.2, 0.0, 0.0])


@pytest.fixture
def disturbance():
    return Box.around([0.0] * 4, [0.05, 0.05, 0.0, 0.025])


@pytest.fixture
def make_tracker():
    """``make_tracker(seed, **options)``: a small tracker with weights of that seed."""

    def make(seed: int = 0, **options) -> Tracker:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return Tracker(**{"state_dim": 4, "control_dim": 2, "lookahead": 3, "hidden": [8, 8]} | options)

    return make
