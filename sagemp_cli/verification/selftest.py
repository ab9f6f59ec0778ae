"""A short soundness test of a propagator, for ``sagemp doctor``: sampled rollouts must lie in the tube.

It can only refute: a propagator that passes may still be wrong elsewhere. The test suite looks harder.
"""

from __future__ import annotations

import itertools

import torch

from sagemp_cli.dynamics.unicycle import Unicycle
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.loop.tracker import Tracker
from sagemp_cli.reachability.propagator import Propagator
from sagemp_cli.sets import Box

HORIZON = 5
TOLERANCE = 1e-9
"""Slack of a propagator that does not claim to include rounding; a rigorous one gets none."""


def sound_on_a_small_loop(propagator: Propagator, *, rollouts: int = 512) -> tuple[bool, float]:
    """Whether the tube of a small unicycle loop holds all sampled rollouts, and its widest side at the end.

    The loop has a random tracker, a wide start box and corner as well as inner disturbances, so that every
    relaxation that a unicycle needs is at work.

    Args:
        propagator: what is tested.
        rollouts: sampled rollouts beside those from the corners of the start box.
    """
    generator = torch.Generator().manual_seed(0)
    robot = Unicycle(
        dt=0.1,
        control_lower=[-1.5, -2.0],
        control_upper=[1.5, 2.0],
        state_lower=[-9.0, -9.0, -9.0, -9.0],
        state_upper=[9.0, 9.0, 9.0, 9.0],
    )
    tracker = Tracker(state_dim=4, control_dim=2, lookahead=2, hidden=[4])
    with torch.no_grad():
        for parameter in tracker.parameters():
            parameter.copy_(0.5 * torch.randn(parameter.shape, dtype=torch.float64, generator=generator))
    steps = torch.arange(HORIZON + 1, dtype=torch.float64)[:, None]
    reference = steps * _numbers([0.1, 0.02, 0.0, 0.0]) + _numbers([0.0, 0.0, 0.2, 1.0])
    loop = ClosedLoop(robot, tracker, reference)
    start = Box.around([0.0, 0.0, 0.2, 1.0], [0.2, 0.2, 0.3, 0.1])
    disturbance = Box.around([0.0] * 4, [0.05, 0.05, 0.0, 0.025])

    with torch.no_grad():
        tube = propagator.propagate(loop, start, disturbance)
        corners = itertools.product(*zip(start.lower.tolist(), start.upper.tolist(), strict=True))
        x = torch.cat([_numbers(list(corners)), start.sample(rollouts, generator)])
        inner = disturbance.sample(len(x) * HORIZON, generator).unflatten(0, (len(x), HORIZON))
        extreme = torch.where(inner > 0, disturbance.upper, disturbance.lower)
        states, _ = loop.rollout(torch.cat([x, x]), torch.cat([inner, extreme]))
    slack = 0.0 if propagator.rigorous else TOLERANCE
    inside = (tube.lower - slack <= states) & (states <= tube.upper + slack)
    sound = bool(tube.bounded.all()) and bool(inside.all())
    return sound, float(tube.width[..., -1, :].max())


def _numbers(values: list) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)
