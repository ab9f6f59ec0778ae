"""Far from the origin float64 rounds away what happens: tubes enclose what exact arithmetic makes of a loop.

Sets are points, so that the tube is nothing but the rounding that was accounted for: a term that is forgotten shows.
"""

from fractions import Fraction

import pytest
import torch

from sagemp_cli.dynamics import Dynamics
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.loop.tracker import Tracker
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.crown.best import Best
from sagemp_cli.reachability.crown.crown import Crown
from sagemp_cli.reachability.interval.interval import Interval
from sagemp_cli.sets import Box, Tube


class Cart(Dynamics):
    """Two positions that are steered directly."""

    state_names = ("px", "py")
    state_units = ("m", "m")
    control_names = ("vx", "vy")
    control_units = ("m/s", "m/s")
    position = (0, 1)

    def derivative(self, x, u):
        return u


COAST = [0.7, -0.3]


def cart_loop(*, gain: float, far: float, horizon: int) -> ClosedLoop:
    """``u = COAST + gain e`` by way of ``relu(e) - relu(-e)``, along a line that begins far away."""
    limits = {"control_lower": [-5.0] * 2, "control_upper": [5.0] * 2}
    cart = Cart(dt=0.1, state_lower=[-9.0] * 2, state_upper=[9.0] * 2, **limits)
    tracker = Tracker(state_dim=2, control_dim=2, lookahead=1, hidden=[4], negative_slope=0.0, control_offset=COAST)
    eye = torch.eye(2, dtype=torch.float64)
    with torch.no_grad():
        tracker.layers[0].weight.copy_(torch.cat([eye, -eye]))
        tracker.layers[0].bias.zero_()
        tracker.layers[1].weight.copy_(gain * torch.cat([eye, -eye], dim=1))
        tracker.layers[1].bias.zero_()
    steps = torch.arange(horizon + 1, dtype=torch.float64)
    return ClosedLoop(cart, tracker.requires_grad_(False), torch.stack([far + 0.1 * steps, far - 0.3 * steps], -1))


def exact_cart(loop: ClosedLoop, x: list[float], *, gain: float) -> list[list[Fraction]]:
    """Its states in exact arithmetic, without disturbance."""
    dt, states = Fraction(loop.dynamics.dt), [[Fraction(value) for value in x]]
    for reference in loop.references[1:].tolist():
        errors = [Fraction(p) - value for p, value in zip(reference, states[-1], strict=True)]
        controls = [Fraction(c) + Fraction(gain) * e for c, e in zip(COAST, errors, strict=True)]
        states.append([value + dt * u for value, u in zip(states[-1], controls, strict=True)])
    return states


def encloses(tube: Tube, states: list[list[Fraction]]) -> bool:
    return all(
        Fraction(low) <= value <= Fraction(high)
        for lower, upper, row in zip(tube.lower.tolist(), tube.upper.tolist(), states, strict=True)
        for low, high, value in zip(lower, upper, row, strict=True)
    )


def operation_by_operation(loop, start, disturbance) -> Tube:
    """Affine forms as values, as training uses them: where autograd is on nothing is compiled."""
    tube = Affine().run(loop, start, disturbance).tube
    return Tube(tube.lower.detach(), tube.upper.detach())


PATHS = {
    "compiled": Affine().propagate,
    "operation by operation": operation_by_operation,
    "interval": Interval().propagate,
    "crown": Crown().propagate,
    "best": Best().propagate,
}


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize(
    ("gain", "horizon"),
    [(4.0, 20), (0.0, 20), (3e4, 2)],
    ids=["errors contract", "errors add up from step to step", "one step amplifies what went into its relu"],
)
@pytest.mark.parametrize("far", [5e5, 5e6])
def test_the_tube_of_a_point_holds_its_exact_rollout_far_from_the_origin(path, gain, horizon, far):
    loop = cart_loop(gain=gain, far=far, horizon=horizon)
    for i in range(6):
        x = [far + 0.1 * i / 7, far - 0.3 * i / 11]
        point, zero = torch.tensor(x, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
        tube = PATHS[path](loop, Box(point, point), Box(zero, zero))
        assert encloses(tube, exact_cart(loop, x, gain=gain))


class Sum:
    """``x+ = (x 0.75 + 2^40) - (x 0.5 + 2^40) + 0.7 x``: every sum loses bits that plain float64 never sees again."""

    horizon, state_dim = 8, 2

    def step(self, k, x, w):
        return (x * 0.75 + 2.0**40) - (x * 0.5 + 2.0**40) + x * 0.7 + w


@pytest.mark.parametrize("path", PATHS)
def test_what_is_rounded_within_a_step_is_carried_into_the_next(path):
    loop, x, zero = Sum(), [1 / 3, -0.7], torch.zeros(2, dtype=torch.float64)
    point = torch.tensor(x, dtype=torch.float64)
    tube = PATHS[path](loop, Box(point, point), Box(zero, zero))
    factor = Fraction(1, 4) + Fraction(0.7)
    assert encloses(tube, [[Fraction(value) * factor**k for value in x] for k in range(loop.horizon + 1)])


ALMOST_ONE, TIMES = 1 + 2.0**-52, 400


class Creeping(Cart):
    """``x+ = x + relu(1.4 x (1 + 2^-52)^400)``: each factor adds 1.4 units in the last place and float64 adds one, so
    that what goes into the relu is wrong by a hundred times what a single operation may lose.
    """

    def derivative(self, x, u):
        y = x * 1.4
        for _ in range(TIMES):
            y = y * ALMOST_ONE
        return torch.relu(y) + 0.0 * u


@pytest.mark.parametrize("path", PATHS)
def test_what_was_lost_on_the_way_into_a_relaxed_operation_is_carried_through_it(path):
    limits = {"control_lower": [-5.0] * 2, "control_upper": [5.0] * 2}
    robot = Creeping(dt=1.0, state_lower=[-9.0] * 2, state_upper=[9.0] * 2, **limits)
    loop = cart_loop(gain=0.0, far=0.0, horizon=1)
    loop = ClosedLoop(robot, loop.tracker, loop.references)
    x, zero = [1.0, 1.003], torch.zeros(2, dtype=torch.float64)
    point = torch.tensor(x, dtype=torch.float64)
    tube = PATHS[path](loop, Box(point, point), Box(zero, zero))
    after = [value * (1 + Fraction(1.4) * Fraction(ALMOST_ONE) ** TIMES) for value in map(Fraction, x)]
    assert encloses(tube, [list(map(Fraction, x)), after])
