"""The paper's tracking loss against its formulas written out by hand."""

from __future__ import annotations

import math

import pytest
import torch

from sagemp_cli.trackers.losses import LossWeights, limit_loss, rollout_loss, tracking_loss


def softplus(z: float) -> float:
    return math.log1p(math.exp(z))


def test_tracking_is_the_mean_squared_distance_over_steps_and_batch():
    states = torch.tensor([[[1.0, 2.0], [0.0, 0.0]], [[1.0, 1.0], [3.0, 0.0]]])
    targets = torch.tensor([[[0.0, 0.0], [0.0, 0.0]], [[1.0, 1.0], [0.0, -4.0]]])
    assert tracking_loss(states, targets).item() == pytest.approx((5.0 + 0.0 + 0.0 + 25.0) / 4)


def test_limits_cost_softplus_of_what_exceeds_them_on_either_side():
    values = torch.tensor([[0.5, -2.0], [3.0, 0.0]], dtype=torch.float64)
    lower, upper = torch.tensor([-1.0, -1.0]).double(), torch.tensor([1.0, 2.0]).double()
    rows = [
        softplus(0.5 - 1.0) + softplus(-1.0 - 0.5) + softplus(-2.0 - 2.0) + softplus(-1.0 + 2.0),
        softplus(3.0 - 1.0) + softplus(-1.0 - 3.0) + softplus(0.0 - 2.0) + softplus(-1.0 - 0.0),
    ]
    assert limit_loss(values, lower, upper).item() == pytest.approx(sum(rows) / 2, rel=1e-12)


def test_the_loss_is_the_weighted_sum_of_its_three_parts(unicycle):
    generator = torch.Generator().manual_seed(0)
    states, targets = torch.randn(2, 3, 5, 4, dtype=torch.float64, generator=generator)
    controls = torch.randn(3, 5, 2, dtype=torch.float64, generator=generator)
    total, parts = rollout_loss(unicycle, states, controls, targets, LossWeights(track=2.0, state=0.5, control=3.0))
    assert parts["track"] == pytest.approx(tracking_loss(states, targets).item())
    assert parts["state"] == pytest.approx(limit_loss(states, unicycle.state_lower, unicycle.state_upper).item())
    assert parts["control"] == pytest.approx(
        limit_loss(controls, unicycle.control_lower, unicycle.control_upper).item()
    )
    assert total.item() == pytest.approx(2.0 * parts["track"] + 0.5 * parts["state"] + 3.0 * parts["control"])


def test_the_gradient_pulls_a_state_to_its_target(unicycle):
    states = torch.zeros(1, 1, 4, dtype=torch.float64, requires_grad=True)
    targets = torch.ones(1, 1, 4, dtype=torch.float64)
    controls = torch.zeros(1, 1, 2, dtype=torch.float64)
    rollout_loss(unicycle, states, controls, targets, LossWeights(state=0.0))[0].backward()
    torch.testing.assert_close(states.grad, torch.full_like(states, -2.0))
