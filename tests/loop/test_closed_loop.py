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


def test_the_numbers_of_a_step_are_its_padded_window():
    loop = unicycle_loop(torch.randn(3, 1, 7, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1)))
    numbers = loop.numbers()
    assert numbers.shape == (6, 3, 1, 16)
    for k in range(6):
        assert torch.equal(numbers[k], loop.window(k).flatten(-2))
    last = loop.references[..., -1, :]
    assert torch.equal(numbers[-1], torch.cat([last] * 4, dim=-1))  # step K-1 reads p_K and three copies of it


def test_a_step_from_its_numbers_is_the_step_and_its_control():
    generator = torch.Generator().manual_seed(1)
    loop = unicycle_loop(torch.randn(7, 4, dtype=torch.float64, generator=generator))
    x, w = torch.randn(2, 5, 4, dtype=torch.float64, generator=generator)
    for k, numbers in enumerate(loop.numbers()):
        after, control = loop.step_given(numbers, x, w)
        assert torch.equal(after, loop.step(k, x, w)) and torch.equal(control, loop.control(k, x))


def test_a_rollout_repeats_its_steps():
    loop = unicycle_loop(torch.zeros(4, 4, dtype=torch.float64))
    w = torch.full((3, 4), 0.1, dtype=torch.float64)
    states, controls = loop.rollout(torch.ones(4, dtype=torch.float64), w)
    assert states.shape == (4, 4) and controls.shape == (3, 2)
    for k in range(3):
        assert torch.equal(states[k + 1], loop.step(k, states[k], w[k]))
