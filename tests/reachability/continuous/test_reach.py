"""Tubes in continuous time enclose every solution at the instants and between them, whatever the signal of w."""

import dataclasses
import math

import pytest
import torch

from sagemp_cli.errors import UnsupportedOperationError, UsageError
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.continuous.reach import reach_continuously
from sagemp_cli.reachability.crown.crown import Crown
from sagemp_cli.scenes.scene import Scene
from sagemp_cli.sets import Between, Box
from sagemp_cli.verification.verdict import Outcome, assess


class Loop:
    """A pendulum with damping under a saturated controller, sampled every 0.1 s."""

    horizon, state_dim, period = 12, 2, 0.1

    def numbers(self):
        return torch.zeros(self.horizon, 0, dtype=torch.float64)

    def control_given(self, numbers, x):
        return (-2 * x[..., :1] - x[..., 1:]).clamp(-1.0, 1.0)

    def rate(self, x, u):
        return torch.cat([x[..., 1:], torch.sin(x[..., :1]) - 0.2 * x[..., 1:] + 3 * u], -1)


def box(lower, upper):
    return Box(torch.tensor(lower, dtype=torch.float64), torch.tensor(upper, dtype=torch.float64))


START = box([[0.2, -0.1], [0.25, -0.1]], [[0.25, 0.1], [0.3, 0.1]])
W = box([-0.02, -0.3], [0.04, 0.3])


def solutions(loop, start, w, signals, fine=40):
    """States of rollouts ``(R, K fine + 1, n)`` by RK4, under signals ``(R, K fine, n)`` constant on each piece."""
    x, h, states = start, loop.period / fine, [start]
    for i in range(signals.shape[1]):
        if i % fine == 0:
            u = loop.control_given(loop.numbers()[i // fine], x)
        f = lambda x, u=u, v=signals[:, i]: loop.rate(x, u) + v  # noqa: E731
        a = f(x)
        b = f(x + h / 2 * a)
        c = f(x + h / 2 * b)
        d = f(x + h * c)
        x = x + h / 6 * (a + 2 * b + 2 * c + d)
        states.append(x)
    return torch.stack(states, 1)


def signals(loop, w, count, fine, generator):
    """Switching ones: constant, at random times, and at many multiples of the sample rate."""
    steps = loop.horizon * fine
    found = []
    for r in range(count):
        every = [steps, fine, fine // 2, 4, 2, 1][r % 6]
        blocks = torch.rand(-(-steps // every), w.dim, generator=generator) < 0.5
        found.append(torch.where(blocks.repeat_interleave(every, 0)[:steps], w.lower, w.upper))
    return torch.stack(found)


@pytest.mark.parametrize(("substeps", "order"), [(1, 1), (1, 2), (2, 2), (1, 3), (4, 1)])
def test_no_solution_leaves_the_sets_at_or_between_the_instants(substeps, order):
    loop, fine, generator = Loop(), 40, torch.Generator().manual_seed(0)
    reach = reach_continuously(Affine(), loop, START, W, substeps=substeps, order=order)
    assert reach.flow is not None and bool(torch.isfinite(reach.tube.upper).all())
    for c in range(2):
        cell = Box(START.lower[c], START.upper[c])
        x = torch.where(torch.rand(60, 2, generator=generator) < 0.5, cell.lower, cell.upper)
        states = solutions(loop, x, W, signals(loop, W, 60, fine, generator), fine)
        at = states[:, ::fine]
        slack = 1e-9  # of the simulation
        assert bool(((reach.tube.lower[c] - slack <= at) & (at <= reach.tube.upper[c] + slack)).all())
        # within each part, the box that the flow stays in, and the chord with its bulge
        flow, per = reach.flow, fine // substeps
        pieces = states[:, :-1].unflatten(1, (loop.horizon, substeps, per))
        low, high = flow.lower[c, :, :, None], flow.upper[c, :, :, None]
        assert bool(((low - slack <= pieces) & (pieces <= high + slack)).all())
        s = (torch.arange(per, dtype=torch.float64) / per)[:, None]
        ends = states[:, ::per]
        first = ends[:, :-1].unflatten(1, (loop.horizon, substeps))[..., None, :]
        last = ends[:, 1:].unflatten(1, (loop.horizon, substeps))[..., None, :]
        bulge = flow.curve[c, :, :, None] * 2 * s * (1 - s)
        swing = 2 * loop.period / substeps * W.radius * s * (1 - s)
        off = (pieces - (first + s * (last - first))).abs()
        assert bool((off <= bulge + swing + 2 * flow.drift[c, :, :, None] + slack).all())


def test_a_higher_order_and_more_substeps_are_no_wider_where_the_remainder_matters():
    loop = Loop()
    widths = [
        float(reach_continuously(Affine(), loop, START, W, substeps=s, order=p).tube.width[:, -1].sum())
        for s, p in ((1, 1), (1, 2), (2, 2))
    ]
    assert widths[0] > widths[1] > widths[2]


def test_what_escapes_within_a_period_ends_the_tube_there_and_says_so():
    class Escaping(Loop):
        def rate(self, x, u):
            return x * x * 4 + 0 * u

    reach = reach_continuously(Affine(), Escaping(), box([[1.0, 1.0]], [[1.1, 1.1]]), box([0.0, 0.0], [0.0, 0.0]))
    assert math.isinf(float(reach.tube.upper[0, -1, 0]))
    assert any("no box was found" in note for note in reach.notes)


@pytest.mark.parametrize("after", [torch.clone, torch.tanh])
def test_an_angle_that_may_jump_within_a_part_ends_the_tube_there(after):
    """Also where what is made of it is bounded wherever it is."""

    class Turning(Loop):
        state_dim = 3

        def control_given(self, numbers, x):
            return 0 * x[..., :1]

        def rate(self, x, u):  # y falls through 0 where x is negative: the angle jumps from pi to -pi
            y, along = x[..., :1], x[..., 1:2]
            return torch.cat([0 * y - 1 + u, 0 * along, after(torch.atan2(y, along) * 1)], -1)

    start = box([[0.05, -1.0, 0.0]], [[0.06, -1.0, 0.0]])
    reach = reach_continuously(Affine(), Turning(), start, box([0.0] * 3, [0.0] * 3), substeps=4)
    assert math.isinf(float(reach.tube.upper[0, 1, 2]))


def test_the_period_is_cut_until_an_enclosure_is_found():
    class Fast(Loop):
        def rate(self, x, u):
            return torch.cat([x[..., 1:], -4 * x[..., :1] - 12 * x[..., 1:] + u], -1)

    reach = reach_continuously(Affine(), Fast(), START, W)
    assert reach.flow is not None and reach.flow.division.substeps > 1
    assert bool(torch.isfinite(reach.tube.upper).all())


@pytest.mark.parametrize(
    ("rate", "lower", "upper"),
    [
        (lambda x: torch.sqrt(x), 0.0, 0.1),  # of any slope at 0: more than one solution starts there
        (lambda x: -torch.sqrt(x), 0.001, 0.002),  # reaches it within the first period
        (lambda x: 1 / x, -0.1, 0.1),
        (lambda x: -1 / x, 0.05, 0.06),
        (lambda x: torch.log(x), 0.0, 0.1),
        (lambda x: torch.tan(x), 1.5, 1.6),
        (lambda x: torch.exp(torch.exp(20 * x)), 0.5, 0.6),
    ],
)
def test_a_rate_without_bounds_or_slope_where_the_state_may_be_ends_the_tube_there_and_says_so(rate, lower, upper):
    class Rough(Loop):
        state_dim = 1

        def control_given(self, numbers, x):
            return 0 * x

        def rate(self, x, u):
            return rate(x) + u

    reach = reach_continuously(Affine(), Rough(), box([[lower]], [[upper]]), box([0.0], [0.0]), substeps=4)
    assert math.isinf(float(reach.tube.upper[0, 1, 0])) and reach.tube.lower[0, 0, 0] == lower
    (note,) = [note for note in reach.notes if "no box was found that the flow stays in" in note]
    assert "period 0" in note and "\n" not in note


def test_a_part_that_cannot_be_made_small_enough_ends_the_tube_and_says_how_small_it_was():
    class Stiff(Loop):
        def rate(self, x, u):
            return -1e5 * x + u

    reach = reach_continuously(Affine(), Stiff(), START, W)
    assert not bool(torch.isfinite(reach.tube.upper[:, -1]).any())
    assert any("no box was found" in note and "0.1 s" in note for note in reach.notes)


@pytest.mark.parametrize("period", [0.0, -0.1, math.nan, math.inf])
def test_a_period_that_is_none_is_refused(period):
    class Still(Loop):
        pass

    Still.period = period
    with pytest.raises(UsageError, match="the period must be a positive number of seconds"):
        reach_continuously(Affine(), Still(), START, W)


@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0])
@pytest.mark.parametrize("side", ["curve", "drift", "jump", "state_lower", "state_upper"])
def test_what_is_no_bound_between_the_instants_leaves_them_unbounded(side, value):
    found = reach_continuously(Affine(), Loop(), START, W, substeps=2)
    sound = assessed(found, found.flow)
    assert str(sound.verdicts[0]) == "SAFE"
    if side.startswith("state") and value == -1.0:
        return
    spoilt = getattr(found.flow, side).clone()
    spoilt[1, 3, 1, 0] = value
    verdict = assessed(found, dataclasses.replace(found.flow, **{side: spoilt})).verdicts[0]
    assert verdict.outcome is Outcome.UNBOUNDED and verdict.step == 4


def assessed(found, flow):
    free = Box(torch.tensor([-math.inf] * 2), torch.tensor([math.inf] * 2))
    scene = Scene(Box(torch.tensor([-9.0]), torch.tensor([9.0])), (), free)
    return assess(
        found.tube,
        scene,
        cell_reference=torch.zeros(2, dtype=torch.int64),
        position=[0],
        state_names=("angle", "rate"),
        between=Between.CONTINUOUS,
        lines=flow.lines(found.tube, W, Loop.period),
    )


def test_propagators_without_continuous_time_are_refused():
    with pytest.raises(UnsupportedOperationError, match="'crown' bounds loops at their instants only"):
        reach_continuously(Crown(), Loop(), START, W)


@pytest.mark.parametrize(("substeps", "order"), [(3, 2), (0, 2), (1, 0)])
def test_a_division_that_is_none_is_refused(substeps, order):
    with pytest.raises(UsageError, match="substeps|order"):
        reach_continuously(Affine(), Loop(), START, W, substeps=substeps, order=order)
