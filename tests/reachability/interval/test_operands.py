"""What goes into every operation by interval arithmetic: in step with affine forms, sound, only where needed."""

import pytest
import torch
from random_programs import escaped, random_problem, worst_rollouts

from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.crown.best import Best
from sagemp_cli.reachability.crown.crown import Crown
from sagemp_cli.reachability.interval.form import IntervalForm
from sagemp_cli.reachability.interval.interval import Interval
from sagemp_cli.reachability.interval.operands import operands, sharper
from sagemp_cli.reachability.program.loops import recorded
from sagemp_cli.sets import Box

from ..propagator_cases import rollouts

NOTHING = Box.around([0.0, 0.0], [0.0, 0.0])
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


def norm(x):
    return torch.sqrt(torch.square(x) @ torch.ones(2, 2, dtype=torch.float64))


def share(x):
    e = torch.exp(x)
    return e / e.sum(-1, keepdim=True)


class Step:
    horizon, state_dim = 1, 2

    def __init__(self, function):
        self.function = function

    def step(self, k, x, w):
        return self.function(x, w)


@pytest.mark.parametrize("propagator", [Affine(), Crown(), Best(), Interval()], ids=lambda p: p.name)
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
    assert bool(torch.isinf(tube.width[1]).all())


def test_cells_that_need_no_help_are_not_disturbed():
    loop = Step(lambda x, w: torch.sqrt(torch.square(x) @ torch.ones(2, 2, dtype=torch.float64)) + w)
    lower = torch.tensor([[0.9, 0.9], [0.1, 0.0]], dtype=torch.float64)
    both = Box(lower, torch.ones(2, 2, dtype=torch.float64))
    tube = Affine().propagate(loop, both, NOTHING)
    alone = Affine().propagate(loop, Box(lower[0], torch.ones(2, dtype=torch.float64)), NOTHING)
    assert torch.equal(tube.lower[0], alone.lower) and torch.equal(tube.upper[0], alone.upper)


@pytest.mark.parametrize("seed", range(40))
def test_operands_come_in_the_order_of_the_forms_and_hold(seed):
    loop, start, disturbance = random_problem(seed)
    program = recorded(loop, start, disturbance).programs[0]
    x, w = (IntervalForm(box.lower, box.upper) for box in (Box(start.lower[None], start.upper[None]), disturbance))
    found = operands(program, x, w, IntervalForm(torch.zeros(0), torch.zeros(0)))
    step = Affine().run(loop, start, disturbance, horizon=1, keep_steps=True).steps[0]
    assert [(h.name, h.size) for h in found] == [(r.name, r.radius.shape[-1]) for r in step.relaxed]
    known = sharper(found, None, where=torch.tensor([True]))
    tube = Affine().run(loop, start, disturbance, horizon=1, hints=[known]).tube
    assert escaped(tube, worst_rollouts(loop, start, disturbance, count=200, rounds=3)[:, :2]) == 0
