"""The closed loop and its folded form."""

import torch

from sagemp_cli.dynamics import Unicycle
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.trackers import Tracker


def unicycle_loop(references: torch.Tensor, seed: int = 0) -> ClosedLoop:
    torch.manual_seed(seed)
    wide = [10.0] * 4
    dynamics = Unicycle(
        dt=0.1,
        control_lower=[-2.0, -2.0],
        control_upper=[2.0, 2.0],
        state_lower=[-w for w in wide],
        state_upper=wide,
    )
    tracker = Tracker(
        state_dim=4, control_dim=2, lookahead=4, hidden=[8, 8], error_scale=[1, 2, 0.5, 1], control_scale=[0.5, 2]
    )
    return ClosedLoop(dynamics, tracker, references)


def test_folding_the_first_layer_changes_a_step_by_rounding_only():
    generator = torch.Generator().manual_seed(1)
    loop = unicycle_loop(torch.randn(3, 1, 7, 4, dtype=torch.float64, generator=generator))
    folded = loop.folded()
    assert (folded.horizon, folded.state_dim) == (6, 4)
    x = torch.randn(3, 5, 4, dtype=torch.float64, generator=generator)
    w = torch.randn(3, 5, 4, dtype=torch.float64, generator=generator)
    for k in range(6):
        torch.testing.assert_close(folded.step(k, x, w), loop.step(k, x, w), rtol=1e-14, atol=1e-14)


def test_the_folded_first_layer_reads_the_padded_lookahead():
    references = torch.zeros(4, 4, dtype=torch.float64)
    references[-1] = 1.0
    loop = unicycle_loop(references)
    weight, bias = loop.folded().weight, loop.folded().biases[-1]
    x = torch.full((4,), 0.25, dtype=torch.float64)
    padded = loop.references[-1].expand(4, 4)  # step K-1 reads p_K and three copies of it
    expected = loop.tracker.layers[0](((padded - x) * loop.tracker.error_scale).flatten())
    torch.testing.assert_close(weight @ x + bias, expected, rtol=1e-13, atol=1e-13)


def test_a_rollout_repeats_its_steps():
    loop = unicycle_loop(torch.zeros(4, 4, dtype=torch.float64))
    w = torch.full((3, 4), 0.1, dtype=torch.float64)
    states, controls = loop.rollout(torch.ones(4, dtype=torch.float64), w)
    assert states.shape == (4, 4) and controls.shape == (3, 2)
    for k in range(3):
        assert torch.equal(states[k + 1], loop.step(k, states[k], w[k]))
