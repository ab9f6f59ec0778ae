"""A control that lags: what may be said of it, and rollouts that are solutions under it."""

import pytest
import torch

from sagemp_cli.dynamics.unicycle import Unicycle
from sagemp_cli.errors import ConfigError
from sagemp_cli.execution.open_loop import OpenLoop
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.loop.tracker import Tracker
from sagemp_cli.sets import Box

LIMITS = {
    "control_lower": [-1.5, -2.0],
    "control_upper": [1.5, 2.0],
    "state_lower": [-9.0] * 4,
    "state_upper": [9.0] * 4,
}


def robot(time="continuous", **lag):
    return Unicycle(dt=0.1, time=time, **LIMITS, **lag)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"time": "discrete", "delay": 0.02}, "in discrete time there are none"),
        ({"time": "discrete", "jitter": 0.01}, "in discrete time there are none"),
        ({"delay": 0.11}, "at most one period together"),
        ({"delay": 0.06, "jitter": 0.05}, "at most one period together"),
        ({"delay": -0.01}, "delay must be a number of seconds"),
        ({"delay": [0.03, 0.02]}, "delay must be a number of seconds"),
        ({"jitter": [0.01]}, "jitter must be a number of seconds"),
        ({"jitter": float("nan")}, "jitter must be a number of seconds"),
        ({"delay": float("inf")}, "delay must be a number of seconds"),
    ],
)
def test_a_lag_that_cannot_be_is_one_line(options, message):
    with pytest.raises(ConfigError, match=message):
        robot(**options)


def test_no_lag_is_no_lag():
    assert not robot().control_lag and not robot(delay=0.0, jitter=[0.0, 0.0]).control_lag
    w = Box.around([0.0] * 4, [0.1] * 4)
    assert robot().unknowns(w) is w
    late = robot(delay=0.02, jitter=[0.001, 0.002]).unknowns(w)
    assert late.lower[4:].tolist() == [0.0, 0.001] and late.upper[4:].tolist() == [0.02, 0.002]


def test_a_robot_may_have_a_lag_of_its_own():
    """Of its motors, say, as in the project that `sagemp init` makes."""
    model = robot()
    model.lag = 0.25
    w = torch.zeros(3, 4, dtype=torch.float64)
    assert not model.control_lag and model.completed(w) is w


def solved(model, x, held, u, w, delay, seconds, fine=1000):
    """Euler's method of small steps: what a rollout is, by other means."""
    h = seconds / fine
    for i in range(fine):
        x = x + h * (model.derivative(x, held if (i + 0.5) * h < delay else u) + w)
    return x


def test_a_rollout_is_a_solution_whose_control_is_of_an_older_state_and_comes_late():
    model, steps = robot(delay=0.05, jitter=0.03), 3
    tracker = Tracker(state_dim=4, control_dim=2, lookahead=1, hidden=[4])
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in tracker.parameters():
            parameter.copy_(0.5 * torch.randn(parameter.shape, dtype=torch.float64, generator=generator))
    reference = torch.arange(steps + 1, dtype=torch.float64)[:, None] * torch.tensor([0.1, 0.02, 0.1, 0.0])
    loop = ClosedLoop(model, tracker, reference)
    rates = torch.tensor([[0.1, 0.0, 0.3, -0.2], [0.0, 0.2, 0.0, 0.1], [-0.1, 0.0, 0.1, 0.0]], dtype=torch.float64)
    late = torch.tensor([[0.04, 0.02], [0.035, 0.03], [0.0125, 0.0]], dtype=torch.float64)
    x = torch.tensor([0.0, 0.1, 0.2, 1.0], dtype=torch.float64)
    with torch.no_grad():
        states, controls = loop.rollout(x, torch.cat([rates, late], -1))
        path = model.path(states, controls, torch.cat([rates, late], -1))
        u = [loop.control(0, x)]  # of the first there is no lag
        x1 = solved(model, x, u[0], u[0], rates[0], 0.0, 0.1)
        older = solved(model, x, u[0], u[0], rates[0], 0.0, 0.07)
        u.append(loop.control(1, older))
        x2 = solved(model, x1, u[0], u[1], rates[1], 0.035, 0.1)
        u.append(loop.control(2, x2))
        x3 = solved(model, x2, u[1], u[2], rates[2], 0.0125, 0.1)
        half = solved(model, x1, u[0], u[1], rates[1], 0.035, 0.05)
        played, _ = OpenLoop(model, controls).rollout(x, torch.cat([rates, late], -1))
        still, _ = loop.rollout(x, rates)
    torch.testing.assert_close(controls, torch.stack(u), rtol=0, atol=5e-4)
    torch.testing.assert_close(states[1:], torch.stack([x1, x2, x3]), rtol=0, atol=5e-4)
    assert torch.equal(path[::4], states)
    torch.testing.assert_close(path[6], half, rtol=0, atol=5e-4)
    torch.testing.assert_close(played, states, rtol=0, atol=1e-12)
    assert float((still - states).abs().max()) > 1e-3  # nothing said of it: as little as there may be
