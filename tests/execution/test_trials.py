"""Plans executed open loop and tracked, on a cart whose loops are affine, so that what must happen is known."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from sagemp_cli.dynamics import Dynamics
from sagemp_cli.errors import UsageError
from sagemp_cli.execution import DISTURBANCES, OpenLoop, Trials, require_certified_safe, try_references
from sagemp_cli.loop.tracker import Tracker
from sagemp_cli.problem import Problem
from sagemp_cli.scenes import Ball, Scene
from sagemp_cli.sets import Box
from sagemp_cli.verification.attack.refutation import SoundnessError

K, DT = 20, 0.1
SCENE = Scene(Box([-3.0, -3.0], [5.0, 3.0]), (Ball((1.0, 1.2), 0.3, "disc"),), Box([1.5, -0.5], [2.5, 0.5]))
START, W = Box.around([0.0, 0.0], [0.1, 0.1]), Box.around([0.0, 0.0], [0.15, 0.15])
NONE, RANDOM, WORST = range(3)


class Cart(Dynamics):
    """Two positions that are steered directly."""

    state_names = ("px", "py")
    state_units = ("m", "m")
    control_names = ("vx", "vy")
    control_units = ("m/s", "m/s")
    position = (0, 1)

    def derivative(self, x, u):
        return u


class Trap(Cart):
    """Runs away where ``py > 0.05``, which the plan along ``py = 0`` does not touch: numbers overflow soon."""

    def derivative(self, x, u):
        return u + 1e200 * torch.relu(x[..., 1:] - 0.05) ** 2


def cart(kind: type = Cart) -> Dynamics:
    limits = {"control_lower": [-5.0] * 2, "control_upper": [5.0] * 2}
    return kind(dt=DT, state_lower=[-9.0] * 2, state_upper=[9.0] * 2, **limits)


@pytest.fixture
def tracker():
    """``u = 4 e`` for the next reference, through the linear parts of two leaky ReLUs: relu(e) - relu(-e)."""
    found = Tracker(state_dim=2, control_dim=2, lookahead=1, hidden=[4], negative_slope=0.0)
    with torch.no_grad():
        eye = torch.eye(2, dtype=torch.float64)
        found.layers[0].weight.copy_(torch.cat([eye, -eye]))
        found.layers[0].bias.zero_()
        found.layers[1].weight.copy_(4 * torch.cat([eye, -eye], dim=1))
        found.layers[1].bias.zero_()
    return found


def plans(*heights):
    """Arcs of these heights from the origin to (2, 0)."""
    x = torch.linspace(0, 2, K + 1, dtype=torch.float64)
    return torch.stack([torch.stack([x, h * torch.sin(0.5 * torch.pi * x)], -1) for h in heights])


def tried(tracker, references, *, robot=None, **changes):
    problem = Problem(robot or cart(), SCENE, START, W, K)
    options = {"rollouts": 12, "generator": torch.Generator().manual_seed(3)} | changes
    return try_references(references, problem, tracker=tracker, **options)


def test_an_open_loop_keeps_its_start_error_and_adds_up_the_disturbances():
    controls = torch.full((3, K, 2), 0.5, dtype=torch.float64)
    x = torch.tensor([[0.0, 0.0], [0.3, 0.0], [0.0, -1.0]], dtype=torch.float64)
    w = torch.full((3, K, 2), 0.1, dtype=torch.float64)
    states, played = OpenLoop(cart(), controls).rollout(x, w)
    assert states.shape == (3, K + 1, 2) and torch.equal(played, controls)
    torch.testing.assert_close(states[:, -1], x + K * DT * 0.6)
    shorter, _ = OpenLoop(cart(), controls[0]).rollout(x, w[:, :5])
    torch.testing.assert_close(shorter, states[:, :6])


def test_shapes_are_references_by_kinds_of_disturbance_by_rollouts(tracker):
    found = tried(tracker, plans(0.0, -0.5, -0.6), at_once=2)
    assert DISTURBANCES == ("none", "random", "worst case")
    assert found.inverse.controls.shape == (3, K, 2)
    for trials in (found.open_loop, found.closed_loop):
        assert trials.clearance.shape == trials.reached.shape == trials.safe.shape == (3, 3, 12)
        assert trials.nearest.shape == (3, 3, K + 1, 2)


def test_clearances_are_those_of_the_nearest_rollouts_which_start_in_x_i(tracker):
    found = tried(tracker, plans(0.0, 0.6))
    for trials in (found.open_loop, found.closed_loop):
        distance = SCENE.signed_distance_along(trials.nearest).amin(-1)
        torch.testing.assert_close(distance, trials.clearance.amin(-1))
        assert START.contains(trials.nearest[..., 0, :]).all()


def test_undisturbed_open_loop_rollouts_are_the_plan_shifted_by_the_start(tracker):
    found = tried(tracker, plans(0.5))
    path = found.open_loop.nearest[0, NONE]
    torch.testing.assert_close(path - path[0], plans(0.5)[0])


def test_the_tracker_forgets_the_start_and_the_disturbance_and_the_open_loop_does_not(tracker):
    """A plan that passes the disc by 0.16 m: the start alone may cost the open loop 0.1 m, W another 0.3 m."""
    found = tried(tracker, plans(0.74), rollouts=40)
    assert found.closed_loop.safe.all() and found.closed_loop.reached.all()
    assert not found.open_loop.safe[0, WORST].all()
    lost = [0.16 - found.open_loop.clearance[0, kind].min() for kind in (NONE, RANDOM, WORST)]
    assert lost[NONE] <= 0.1 < lost[WORST]
    # The worst that W can do over the 11 steps to the disc, to first order and for whoever is pushed that way.
    assert 0.1 < lost[WORST] <= 0.1 * 2**0.5 + 0.15 * 2**0.5 * K * DT


def test_a_plan_through_the_obstacle_is_unsafe_in_both_ways(tracker):
    found = tried(tracker, plans(0.0, 1.2))
    assert found.closed_loop.safe[0].all()
    assert not found.closed_loop.safe[1].any() and not found.open_loop.safe[1].any()


def test_safe_does_not_say_that_the_goal_was_reached(tracker):
    short = plans(0.0)
    short[..., 0] *= 0.5
    found = tried(tracker, short)
    assert found.closed_loop.safe.all()
    assert not found.closed_loop.reached.any()


def test_a_rollout_that_overflows_is_not_safe_and_its_clearance_is_minus_infinity(tracker):
    found = tried(tracker, plans(0.0), robot=cart(Trap))
    trials = found.open_loop
    caught = trials.clearance[0, NONE] == -torch.inf
    assert 0 < caught.sum() < 12
    assert torch.equal(trials.safe[0, NONE], ~caught)
    assert not torch.isfinite(trials.nearest[0, NONE]).all()
    assert not torch.isnan(trials.clearance).any()


def test_the_same_generator_gives_the_same_trials(tracker):
    a, b = (tried(tracker, plans(0.3, 0.5)) for _ in range(2))
    for way in ("open_loop", "closed_loop"):
        for field in dataclasses.fields(Trials):
            assert torch.equal(getattr(getattr(a, way), field.name), getattr(getattr(b, way), field.name))


def test_no_rollouts_are_refused(tracker):
    with pytest.raises(UsageError, match="rollouts must be positive, found 0"):
        tried(tracker, plans(0.0), rollouts=0)


def test_a_certified_reference_with_an_unsafe_rollout_is_raised(tracker):
    trials = tried(tracker, plans(0.0, 1.2)).closed_loop
    require_certified_safe([0], trials)
    with pytest.raises(SoundnessError, match="reference 1 is certified, but 36 of its 36 closed-loop rollouts break"):
        require_certified_safe([0, 1], trials)
    late = dataclasses.replace(trials, reached=trials.reached.clone())
    late.reached[0, RANDOM, 7] = False
    message = "reference 0 .* 1 of its 36 .* rollout 7 under disturbances of kind 'random' .* and misses the goal"
    with pytest.raises(SoundnessError, match=message):
        require_certified_safe([0], late)
