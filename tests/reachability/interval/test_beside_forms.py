"""An interval beside every form: what has bounds is bounded, and nothing is wider than by intervals alone."""

import math

import numpy as np
import pytest
import torch
from random_programs import escaped, random_problem, worst_rollouts

from sagemp_cli.reachability.affine import affine
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.affine.compiled import checked, intervals
from sagemp_cli.reachability.affine.compiled.beside import noticeably
from sagemp_cli.reachability.affine.compiled.folding import compiled
from sagemp_cli.reachability.affine.compiled.run import Steps
from sagemp_cli.reachability.crown.best import Best
from sagemp_cli.reachability.crown.crown import Crown
from sagemp_cli.reachability.interval.interval import Interval
from sagemp_cli.reachability.program.loops import record
from sagemp_cli.sets import Box

from ..propagator_cases import DISTURBANCE, START, EveryOperation, line, rollouts, unicycle_loop

NOTHING = Box.around([0.0, 0.0], [0.0, 0.0])
PROPAGATORS = [Affine(), Affine(symbols=6), Crown(), Best()]
FEW_AND_MANY = [*range(8), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(8, 60))]
NEEDLESS = {
    "root of what is not negative": (lambda x, w: torch.sqrt(torch.relu(x)) + w, [0.0, 0.0], [1.0, 1.0]),
    "norm beside 0": (lambda x, w: norm(x) + w, [0.55, 0.5], [0.45, 0.5]),
    "norm at 0": (lambda x, w: norm(x) + w, [0.5, 0.5], [0.5, 0.5]),
    "share of exponentials": (lambda x, w: share(x) + w, [0.0, 0.0], [3.0, 3.0]),
    "logarithm of a sum of squares": (
        lambda x, w: torch.log(0.01 + (x * x).sum(-1, keepdim=True)) + w,
        [0.0, 0.0],
        [1.0] * 2,
    ),
}
SATURATED = {
    "clamp": (lambda x: torch.clamp(x, -1.0, 1.0), 3.0, (-1.0, 1.0)),
    "sigmoid": (torch.sigmoid, 3.0, (1 / (1 + math.exp(3.0)), 1 / (1 + math.exp(-3.0)))),
    "tanh": (lambda x: 2.0 * torch.tanh(x), 30.0, (-2.0, 2.0)),
    "relu": (torch.relu, 1.0, (0.0, 1.0)),
    "abs": (torch.abs, 1.0, (0.0, 1.0)),
    "maximum and minimum with numbers": (lambda x: x.clamp(min=0.5).clamp(max=0.75), 1.0, (0.5, 0.75)),
    "maximum and minimum of values": (
        lambda x: torch.minimum(torch.maximum(x, 0 * x + 0.5), 0 * x + 0.75),
        1.0,
        (0.5, 0.75),
    ),
    "square": (lambda x: x * x, 1.0, (0.0, 1.0)),
}


def norm(x):
    return torch.sqrt(torch.square(x) @ torch.ones(2, 2, dtype=torch.float64))


def share(x):
    e = torch.exp(x)
    return e / e.sum(-1, keepdim=True)


class Step:
    def __init__(self, function, horizon=1, state_dim=2):
        self.function, self.horizon, self.state_dim = function, horizon, state_dim

    def step(self, k, x, w):
        return self.function(x, w)


def not_wider(tube, other):
    """Whether a tube lies within another, but for what the sums of forms and of intervals are rounded by."""
    size = torch.maximum(other.lower.abs(), other.upper.abs())
    doubt = 1e-11 * (1 + torch.where(size.isfinite(), size, 0.0))
    return bool(((tube.lower >= other.lower - doubt) & (tube.upper <= other.upper + doubt)).all())


@pytest.mark.parametrize("propagator", [*PROPAGATORS, Interval()], ids=str)
@pytest.mark.parametrize("name", NEEDLESS)
def test_what_has_bounds_is_bounded(name, propagator):
    function, center, radius = NEEDLESS[name]
    start = Box.around(center, radius)
    loop = Step(function)
    tube, states = propagator.propagate(loop, start, NOTHING), rollouts(loop, start, NOTHING)
    assert bool(torch.isfinite(tube.width).all())
    assert bool(((tube.lower <= states) & (states <= tube.upper)).all())


@pytest.mark.parametrize(
    "function",
    [torch.sqrt, torch.reciprocal, torch.log, lambda x: x**-2],
    ids=["sqrt", "reciprocal", "log", "power"],
)
def test_beyond_a_pole_and_the_end_of_a_domain_stays_infinite(function):
    loop = Step(lambda x, w: function(x) + w)
    tube = Affine().propagate(loop, Box.around([0.0, 1.0], [1.0, 0.5]), NOTHING)
    assert bool(torch.isinf(tube.width[1]).any(-1))


@pytest.mark.parametrize("propagator", PROPAGATORS, ids=str)
@pytest.mark.parametrize("name", SATURATED)
def test_no_tube_reaches_past_a_saturation(name, propagator):
    function, radius, (low, high) = SATURATED[name]
    start, w = Box.around([0.0], [radius]), Box.around([0.0], [0.0])
    tube = propagator.propagate(Step(lambda x, w: function(x), 1, 1), start, w)
    assert tube.lower[1].item() == pytest.approx(low, abs=1e-14)
    assert tube.upper[1].item() == pytest.approx(high, abs=1e-14)


@pytest.mark.parametrize("activation", [torch.relu, torch.tanh, torch.sigmoid], ids=lambda a: a.__name__)
def test_controls_of_a_saturated_network_are_within_its_limits(activation):
    generator = torch.Generator().manual_seed(0)
    first, second, last = (
        3.0 * torch.randn(shape, dtype=torch.float64, generator=generator) for shape in ((8, 2), (8, 8), (2, 8))
    )

    class Controlled:
        horizon, state_dim = 4, 2

        def numbers(self):
            return torch.zeros(4, 0, dtype=torch.float64)

        def step_given(self, numbers, x, w):
            u = torch.clamp(activation(activation(x @ first.T) @ second.T) @ last.T, -0.75, 0.5)
            return 0.9 * x + 0.1 * u + w, u

        def step(self, k, x, w):
            return self.step_given(self.numbers()[k], x, w)[0]

    start, w = Box.around([0.0, 0.0], [1.0, 1.0]), Box.around([0.0, 0.0], [0.01, 0.01])
    found = Affine().reach(Controlled(), start, w, watch=True)
    assert bool((found.control_lower >= -0.75).all()) and bool((found.control_upper <= 0.5).all())
    assert bool((found.control_lower == -0.75).any()) and bool((found.control_upper == 0.5).any())


def test_a_tube_stays_within_the_saturation_for_ever():
    """A loop whose forms grow at every step, and whose intervals cannot."""
    loop = Step(lambda x, w: torch.clamp(1.3 * x + 0.5 * torch.flip(x, [-1]), -1.0, 1.0) + w, horizon=40)
    tube = Affine().propagate(loop, Box.around([0.0, 0.0], [0.2, 0.2]), Box.around([0.0, 0.0], [0.1, 0.1]))
    assert bool((tube.upper[1:] <= 1.1 + 1e-12).all()) and bool((tube.lower[1:] >= -1.1 - 1e-12).all())


@pytest.mark.parametrize("seed", FEW_AND_MANY)
def test_no_propagator_is_wider_than_intervals_on_random_loops(seed):
    loop, start, disturbance = random_problem(seed)
    alone = Interval().propagate(loop, start, disturbance)
    for propagator in PROPAGATORS if seed % 3 == 0 else PROPAGATORS[:1]:
        assert not_wider(propagator.propagate(loop, start, disturbance), alone), propagator


@pytest.mark.parametrize("propagator", PROPAGATORS, ids=str)
def test_no_propagator_is_wider_than_intervals_on_every_operation_and_a_robot(propagator):
    cases = [
        (EveryOperation(), Box.around([0.1, -0.05, 0.2], [r] * 3), Box.around([0.0] * 3, [0.01] * 3))
        for r in (0.01, 0.1, 0.5)
    ]
    cases += [(unicycle_loop(line(0.3), gain=g), START, DISTURBANCE) for g in (0.5, 2.0)]
    for loop, start, w in cases:
        assert not_wider(propagator.propagate(loop, start, w), Interval().propagate(loop, start, w))


@pytest.mark.parametrize("seed", FEW_AND_MANY)
def test_the_worst_rollouts_of_random_loops_stay_inside(seed):
    loop, start, disturbance = random_problem(seed)
    states = worst_rollouts(loop, start, disturbance, count=200, rounds=3)
    assert escaped(Affine().propagate(loop, start, disturbance), states) == 0


@pytest.mark.parametrize("share", [0.9, 0.99])
def test_intervals_that_are_too_narrow_are_found_out(share, monkeypatch):
    honest = intervals._Fold.__call__

    def narrower(self, ends):
        low, high = honest(self, ends)
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        return middle - share * half, middle + share * half

    monkeypatch.setattr(intervals._Fold, "__call__", narrower)
    loop = Step(lambda x, w: torch.clamp(2.0 * x, -1.0, 1.0) + 0.1 * torch.tanh(x), 3)
    start = Box.around([0.2, -0.3], [0.6, 0.8])
    tube, states = Affine().propagate(loop, start, NOTHING), rollouts(loop, start, NOTHING)
    assert bool(((states < tube.lower - 1e-12) | (states > tube.upper + 1e-12)).any())


def test_cells_have_the_tubes_that_they_have_alone():
    """One that intervals make tighter beside one that they do not."""
    loop = Step(lambda x, w: torch.clamp(1.5 * x, -1.0, 1.0) + 0.1 * torch.sin(x) + w, horizon=20)
    lower = torch.tensor([[-2.0, -1.0], [0.0, 0.1], [0.3, 0.3]], dtype=torch.float64)
    upper = torch.tensor([[2.0, 1.0], [0.1, 0.2], [0.31, 0.32]], dtype=torch.float64)
    together = Affine().propagate(loop, Box(lower, upper), NOTHING)
    for c in range(3):
        alone = Affine().propagate(loop, Box(lower[c], upper[c]), NOTHING)
        torch.testing.assert_close(together.lower[c], alone.lower, rtol=1e-9, atol=1e-12)
        torch.testing.assert_close(together.upper[c], alone.upper, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("short, block", [(1, 1), (2, 5), (100, 100)])
@pytest.mark.parametrize("seed", range(6))
def test_how_many_steps_are_checked_at_once_makes_no_difference(seed, short, block, monkeypatch):
    loop, start, disturbance = random_problem(seed)
    tube = Affine().propagate(loop, start, disturbance)
    monkeypatch.setattr(affine, "SHORT", short)
    monkeypatch.setattr(affine, "BLOCK", block)
    other = Affine().propagate(loop, start, disturbance)
    torch.testing.assert_close(other.lower, tube.lower, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(other.upper, tube.upper, rtol=1e-9, atol=1e-12)


def test_a_set_that_is_lost_between_two_checks_is_taken_again_beside_its_intervals():
    """The root's form reaches below 0 at the fourth step, where its interval does not."""
    loop = Step(lambda x, w: 0.5 * x - 0.05 + 0.02 * torch.sqrt(torch.relu(x - 0.01)) + w, horizon=10)
    tube = Affine().propagate(loop, Box.around([1.0, 0.9], [0.1, 0.05]), NOTHING)
    assert bool(torch.isfinite(tube.width).all()) and float(tube.width[-1].max()) < 0.05


def test_intervals_are_carried_along_only_where_they_make_a_difference(monkeypatch):
    taken = []
    honest = Steps.beside_intervals
    monkeypatch.setattr(Steps, "beside_intervals", lambda self, k, *rest: taken.append(k) or honest(self, k, *rest))
    Affine().propagate(unicycle_loop(line(0.3), gain=2.0), START, DISTURBANCE)
    assert len(taken) <= 3 and taken[0] == 0


def test_steps_whose_operands_saturate_late_are_taken_again_beside_their_intervals(monkeypatch):
    def relaxed_by():
        loop = Step(lambda x, w: 1.2 * torch.clamp(torch.sin(2.0 * torch.clamp(x, -1.0, 1.0)), -0.6, 0.9), horizon=12)
        run = Affine().run(loop, Box.around([0.02, 0.01], [0.03, 0.02]), NOTHING)
        return sum(float(band.radius.sum()) for step in run.bands for _, band in step)

    taken = []
    honest = Steps.beside_intervals
    monkeypatch.setattr(Steps, "beside_intervals", lambda self, k, *rest: taken.append(k) or honest(self, k, *rest))
    found = relaxed_by()
    assert taken[0] == 0 and max(taken) > 2 and 1 not in taken
    monkeypatch.setattr(checked, "noticeably", lambda node, lower, *rest: np.zeros(len(lower), dtype=bool))
    assert found < 0.9 * relaxed_by()


def test_what_vanishes_is_not_noticeably_tighter():
    node = compiled(record(lambda x, w: torch.sin(x), torch.zeros(1), torch.zeros(1))).nodes[0]
    wide, none = np.array([[1.0], [1e-260], [0.0]]), np.zeros((3, 1))
    assert noticeably(node, -wide, wide, none, none).tolist() == [True, False, False]
    assert noticeably(node, -wide, wide, -0.6 * wide, 0.6 * wide).tolist() == [True, False, False]
    assert noticeably(node, -wide, wide, -0.7 * wide, 0.7 * wide).tolist() == [False, False, False]
