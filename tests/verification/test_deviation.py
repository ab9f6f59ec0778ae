"""Tubes of the analytical model by way of a learned one: sound, and not by chance."""

import copy

import pytest
import torch

from sagemp_cli.dynamics import Unicycle
from sagemp_cli.errors import UsageError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.loop.tracker import Tracker
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.sets import Box
from sagemp_cli.verification.deviation import ComparedLoop

STEPS = 15
START = Box.around([0.0, 0.0, 0.0, 1.0], [0.1, 0.1, 0.05, 0.05])
W = Box.around([0.0] * 4, [0.02, 0.02, 0.05, 0.05])


def loop_of(robot):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        tracker = Tracker(state_dim=4, control_dim=2, lookahead=3, hidden=[4, 4], control_scale=[0.5, 0.5])
    reference = torch.arange(STEPS + 1, dtype=torch.float64)[:, None] * torch.tensor([0.1, 0.0, 0.0, 0.0]).double()
    return ClosedLoop(robot, tracker, reference + torch.tensor([0.0, 0.0, 0.0, 1.0]).double())


def compared(loop):
    return ComparedLoop(loop.dynamics, loop.tracker, loop.references)


@pytest.fixture(params=["derivative", "state"])
def robot(request, learned_unicycle):
    section = copy.deepcopy(learned_unicycle.__defaults__[0])
    section["model"]["disturbance"] = request.param
    return learned_unicycle(section, drift=0.3)


def rollouts(robot, loop):
    """Of the analytical model: corners and inside, and pushed by gradient ascent on each state's deviation."""
    true = ClosedLoop(robot.analytical, loop.tracker, loop.references)
    g = torch.Generator().manual_seed(0)
    x = START.sample(400, g)
    w = W.sample(400 * STEPS, g).unflatten(0, (400, STEPS))
    x[::2] = torch.where(torch.rand(200, 4, generator=g) < 0.5, START.lower, START.upper)
    w[::2] = torch.where(torch.rand(200, 1, 4, generator=g) < 0.5, W.lower, W.upper)
    for _ in range(3):
        x, w = x.detach().requires_grad_(), w.detach().requires_grad_()
        states, controls = true.rollout(x, w)
        deviation = robot.compared(states[:, :-1], controls)[1]
        gx, gw = torch.autograd.grad(deviation.abs().amax(1).sum(), (x, w))
        x = torch.where(gx > 0, START.upper, START.lower)
        w = torch.where(gw > 0, W.upper, W.lower)
        yield states.detach(), controls.detach(), deviation.detach()


def test_tube_controls_and_deviations_enclose_the_analytical_loop(robot):
    loop = loop_of(robot)
    found = Affine().reach(compared(loop), START, W, watch=True)
    tube, lower, upper = found.tube, found.control_lower, found.control_upper
    widest = torch.zeros(STEPS, 4)
    for states, controls, deviation in rollouts(robot, loop):
        assert (states >= tube.lower - 1e-12).all() and (states <= tube.upper + 1e-12).all()
        both = torch.cat([controls, deviation], dim=-1)
        assert (both >= lower - 1e-12).all() and (both <= upper + 1e-12).all()
        widest = torch.maximum(widest, deviation.abs().amax(0))
    bound = torch.maximum(-lower, upper)[:, 2:]
    assert (bound[:, 0] < 1.2 * widest[:, 0] + 0.02 * W.upper[0]).all()  # the drift, and little more


def test_the_deviation_is_recorded_as_one_identity(robot):
    record = Affine().reach(compared(loop_of(robot)), START, W, watch=True).recording
    assert record.operations.count("identity") == 1


def test_the_learned_robots_own_tube_does_not_enclose_the_analytical_loop(robot):
    loop = loop_of(robot)
    tube = Affine().propagate(loop, START, W)
    states, *_ = next(rollouts(robot, loop))
    assert (states < tube.lower - 1e-3).any() or (states > tube.upper + 1e-3).any()


def test_a_reduced_tube_is_sound_and_wider(robot):
    loop = loop_of(robot)
    tube, wide = (Affine(symbols=s).propagate(compared(loop), START, W) for s in (None, 12))
    for states, *_ in rollouts(robot, loop):
        assert (states >= wide.lower).all() and (states <= wide.upper).all()
    assert (wide.width[-1] >= tube.width[-1] * (1 - 1e-6)).all()


def test_an_exact_model_has_no_deviation_worth_speaking_of(learned_unicycle):
    robot = learned_unicycle(scale=1e-5)
    found = Affine().reach(compared(loop_of(robot)), START, W, watch=True)
    lower, upper = found.control_lower, found.control_upper
    assert float(torch.maximum(-lower, upper)[:, 4:].max()) < 1e-6  # heading and speed, which the network has right


def test_a_robot_of_formulas_has_nothing_to_fold(learned_unicycle):
    robot = learned_unicycle().analytical
    assert isinstance(robot, Unicycle)
    with pytest.raises(UsageError, match="only a learned robot deviates from a model, found Unicycle"):
        compared(loop_of(robot))
