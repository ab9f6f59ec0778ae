"""Interval values: each operation encloses, exactly where it can, and monotonically."""

import math

import pytest
import torch

from sagemp_cli.reachability.interval.form import IntervalForm, evaluate
from sagemp_cli.reachability.interval.interval import Interval
from sagemp_cli.reachability.program.loops import record
from sagemp_cli.reachability.program.program import Instruction
from sagemp_cli.sets import Box

from ..propagator_cases import DISTURBANCE, START, line, unicycle_loop


def interval(lower, upper) -> IntervalForm:
    return IntervalForm(torch.tensor(lower, dtype=torch.float64), torch.tensor(upper, dtype=torch.float64))


OPERATIONS = {
    "sum": lambda a, b: a + b,
    "difference": lambda a, b: 2.0 - a - b,
    "product": lambda a, b: a * b,
    "quotient": lambda a, b: a / (b + 4.0),
    "quotient of a number": lambda a, b: 1.0 / (a + 4.0) + 0 * b,
    "square": lambda a, b: a * a - b**2,
    "layer": lambda a, b: torch.nn.functional.linear(
        torch.stack([a, b], -1), torch.tensor([[0.3, -2.0], [1.0, 0.7]]).double(), torch.tensor([0.1, -5.0]).double()
    )[..., 1],
    "matrix": lambda a, b: (torch.stack([a, b], -1) @ torch.tensor([[0.3], [-2.0]]).double()).sum(-1),
    "larger": lambda a, b: torch.maximum(a, b) - torch.minimum(a, torch.tensor(0.2).double()),
    "angle": lambda a, b: torch.atan2(a, b),
    "clamp": lambda a, b: torch.clamp(a, -0.5, 0.25) + torch.abs(b) + torch.nn.functional.leaky_relu(a, 0.1),
    "waves": lambda a, b: torch.sin(3 * a) * torch.cos(b) + torch.tanh(a - b),
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_an_operation_encloses_all_values_and_grows_with_the_set(name):
    f = OPERATIONS[name]
    generator = torch.Generator().manual_seed(0)
    center = 2 * torch.rand(2, 50, dtype=torch.float64, generator=generator) - 1
    radius = torch.rand(2, 50, dtype=torch.float64, generator=generator)
    t = 2 * torch.rand(400, 2, 50, dtype=torch.float64, generator=generator) - 1
    t[:100] = torch.sign(t[:100])
    points = center + t * radius
    values = f(points[:, 0], points[:, 1])
    program = record(lambda x, w: f(x[0], x[1]).reshape(1) + 0 * x, torch.zeros(2).double(), torch.zeros(1).double())

    def bounded(more):
        x = IntervalForm((center - radius - more).T, (center + radius + more).T)
        zero = torch.zeros(1, dtype=torch.float64)
        found = program.run(x, IntervalForm(zero, zero), evaluate=evaluate).next
        return found.lower[:, 0], found.upper[:, 0]

    lower, upper = bounded(1e-15)
    assert bool((lower <= values).all()) and bool((values <= upper).all())
    wider = bounded(0.1)
    assert bool((wider[0] <= lower).all()) and bool((wider[1] >= upper).all())


def of(kind, *operands: IntervalForm) -> IntervalForm:
    """What an instruction makes of intervals."""
    return evaluate(Instruction(kind, max(len(o.lower) for o in operands), tuple(range(len(operands)))), operands)


def test_a_quotient_by_a_set_with_zero_is_unbounded_and_nothing_is_ever_nan():
    quotient = of("div", interval([1.0, 1.0], [2.0, 2.0]), interval([-1.0, 1.0], [1.0, 2.0]))
    assert quotient.lower.tolist()[0] == -math.inf and quotient.upper.tolist()[0] == math.inf
    assert math.isfinite(quotient.lower.tolist()[1])
    unknown, zero = interval([-math.inf], [math.inf]), interval([0.0], [0.0])
    found = [of("sub", unknown, unknown), of("mul", zero, unknown), of("div", unknown, interval([-9e99], [math.inf]))]
    for value in (*found, of("exp", unknown), of("sin", unknown)):
        assert not bool(torch.isnan(value.lower).any() | torch.isnan(value.upper).any())
    assert of("sin", unknown).bounds == (-1, 1)


def test_ends_are_rounded_outwards():
    total = of("add", interval([0.1], [0.1]), interval([0.2], [0.2]))
    assert float(total.lower) < float(total.upper)
    assert 0.1 + 0.2 in (math.nextafter(float(total.lower), 1), math.nextafter(float(total.upper), 0))


def test_a_cell_inside_the_start_box_has_a_tube_inside():
    loop = unicycle_loop(line(0.3))
    outer = Interval().propagate(loop, START, DISTURBANCE)
    cells = START.split([2, 2, 1, 1])
    inner = Interval().propagate(loop, cells, DISTURBANCE)
    assert bool((inner.lower >= outer.lower).all()) and bool((inner.upper <= outer.upper).all())
    assert isinstance(START, Box)


@pytest.mark.parametrize(
    ("lower", "upper", "expected"),
    [
        ([-1.0, -1.0], [1.0, 1.0], (-2.0, 2.0)),  # what is negative in one term is not made up for in the other
        ([0.0, -1.0], [1.0, 0.0], (0.0, 2.0)),
        ([-1.0, 0.0], [0.0, 1.0], (-2.0, 0.0)),
        ([-1.0, -1.0], [0.0, 0.0], (-1.0, 1.0)),
    ],
)
def test_a_sum_of_terms_of_one_sign_does_not_cross_0_and_any_other_does(lower, upper, expected):
    weight = torch.tensor([[1.0, -1.0]], dtype=torch.float64)
    program = record(
        lambda x, w: torch.nn.functional.linear(x, weight) + 0 * x, torch.zeros(2).double(), torch.zeros(1).double()
    )
    found = program.run(interval([lower], [upper]), interval([[0.0]], [[0.0]]), evaluate=evaluate).next
    low, high = float(found.lower[0, 0]), float(found.upper[0, 0])
    assert low == pytest.approx(expected[0], abs=1e-14) and low <= expected[0]
    assert high == pytest.approx(expected[1], abs=1e-14) and high >= expected[1]
    assert (low == 0.0) == (expected[0] == 0.0) and (high == 0.0) == (expected[1] == 0.0)


def test_the_logarithm_of_a_sum_of_exponentials_encloses_it_and_is_exact_over_a_box():
    from flint import arb, ctx

    generator = torch.Generator().manual_seed(0)
    ends = 10 ** (3 * torch.rand(2, 2, 200, generator=generator, dtype=torch.float64) - 1)
    ends = (ends * torch.where(torch.rand(ends.shape, generator=generator) < 0.5, -1.0, 1.0)).sort(0).values
    a, b = IntervalForm(*ends[:, 0]), IntervalForm(*ends[:, 1])
    low, high = evaluate(Instruction("logaddexp", 200), [a, b]).bounds
    with ctx.workprec(200):
        for x, y, side, sign in ((a.lower, b.lower, low, 1), (a.upper, b.upper, high, -1)):
            for p, q, bound in zip(x.tolist(), y.tolist(), side.tolist(), strict=True):
                exact = (arb(p).exp() + arb(q).exp()).log()
                assert sign * (exact - bound) >= 0 and abs(exact - bound) <= arb(1e-13) * (1 + abs(exact) + abs(arb(p)))
