"""Tubes of steps that compute in float32 hold whatever float32 arithmetic gives, in any order of summation."""

import functools
import math
from fractions import Fraction

import numpy as np
import pytest
import torch

from sagemp_cli.errors import UnsupportedOperationError, UsageError
from sagemp_cli.reachability import reach
from sagemp_cli.reachability.lirpa.auto_lirpa import AutoLirpa
from sagemp_cli.reachability.program.loops import record
from sagemp_cli.reachability.relaxations import float32
from sagemp_cli.sets import Box

PROPAGATORS = ["affine", "crown", "best", "interval"]
UNIT = Fraction(1, 2**24)


def layers(seed=0, width=24, inputs=3):
    g = torch.Generator().manual_seed(seed)
    sizes = [inputs, width, width, 1]
    return [
        (torch.randn(b, a, generator=g) / math.sqrt(a), torch.randn(b, generator=g))
        for a, b in zip(sizes[:-1], sizes[1:], strict=True)
    ]


def network(x, weights):
    h = x
    for i, (weight, bias) in enumerate(weights):
        h = torch.nn.functional.linear(torch.relu(h) if i else h, weight, bias)
    return h


def looped(weights, cast=lambda x: x.float(), inputs=3):
    def step(x, w):
        u = network(cast(x) * 0.3, weights)
        return x + torch.cat([torch.zeros_like(x[..., 1:]), u.double()], -1)

    return step


def in_order(matrix, bias, h, order, *, fused):
    """A product of a matrix and a vector in float32, term by term in an order."""
    total = np.zeros(len(bias), np.float32)
    for j in order:
        if j == len(h):
            total = total + bias
        elif fused:  # exact in float64 but for the sum's own rounding, which is 2^-29 of the other
            total = (matrix[:, j].astype(np.float64) * float(h[j]) + total.astype(np.float64)).astype(np.float32)
        else:
            total = total + matrix[:, j] * h[j]
    return total


def computed(x, weights, rng, *, fused):
    """The network's output in float32, sums in orders of one's own."""
    h = x.astype(np.float32) * np.float32(0.3)
    for i, (weight, bias) in enumerate(weights):
        h = np.maximum(h, np.float32(0)) if i else h
        h = in_order(weight.numpy(), bias.numpy(), h, rng.permutation(len(h) + 1), fused=fused)
    return float(h[0])


@functools.cache
def evaluations(seed):
    """A point and outputs of the network there, in float32, by several ways of computing."""
    rng, weights = np.random.default_rng(seed), layers()
    x = rng.uniform(-3, 3, 3)
    found = [computed(x, weights, rng, fused=fused) for fused in (False, True) for _ in range(25)]
    t = torch.tensor(x).float()
    batch = network((t * 0.3).expand(64, -1), weights)
    return x, [*found, float(network(t * 0.3, weights)), *batch[:, 0].tolist()]


@pytest.mark.parametrize("propagator", PROPAGATORS)
def test_a_step_from_a_point_holds_every_order_of_summation(propagator):
    weights, outside = layers(), 0
    for seed in range(2):
        x, outputs = evaluations(seed)
        start = Box(torch.tensor(x), torch.tensor(x))
        tube = reach(looped(weights), start, horizon=1, propagator=propagator)
        found = [x[2] + u for u in outputs]
        low, high = float(tube.lower[1, 2]), float(tube.upper[1, 2])
        assert low <= min(found) and max(found) <= high
        assert high - low < 1e-3  # it says something
        exact = reach(looped(weights, lambda x: x), start, horizon=1, propagator=propagator)
        outside += sum(not float(exact.lower[1, 2]) <= v <= float(exact.upper[1, 2]) for v in found)
    assert outside > 50  # what float32 gives is no part of the tube in real arithmetic


@pytest.mark.parametrize("propagator", PROPAGATORS)
def test_rollouts_in_float32_stay_in_the_tube(propagator):
    g = torch.Generator().manual_seed(1)
    net = torch.nn.Sequential(
        torch.nn.Linear(2, 12), torch.nn.Tanh(), torch.nn.Linear(12, 12), torch.nn.ELU(), torch.nn.Linear(12, 1)
    )
    for p in net.parameters():
        p.data = 0.4 * torch.randn(p.shape, generator=g)

    def step(x, w):
        u = torch.sigmoid(net(x.float())).double()[..., 0]
        a, r = x[..., 0], x[..., 1]
        return torch.stack([a + 0.1 * r, 0.9 * r - 0.3 * a + 0.1 * u + w[..., 0]], -1)

    start, w = Box.around([0.5, 0.0], [1e-6, 1e-6]), Box.around([0.0], [0.0])
    tube = reach(step, start, w, horizon=12, propagator=propagator)
    x = start.sample(300, g)
    for k in range(12):
        with torch.no_grad():
            x = step(x, torch.zeros(300, 1, dtype=torch.float64))
        assert bool(((x >= tube.lower[k + 1]) & (x <= tube.upper[k + 1])).all()), k


def test_a_float32_tube_holds_that_in_real_arithmetic():
    weights = layers(3)
    start = Box.around([0.1, 0.2, -0.1], [0.01, 0.02, 0.01])
    wide, exact = (reach(looped(weights, cast), start, horizon=3) for cast in (lambda x: x.float(), lambda x: x))
    assert bool((wide.lower <= exact.lower + 1e-12).all() and (wide.upper >= exact.upper - 1e-12).all())


@pytest.mark.parametrize(
    "function",
    [torch.tanh, torch.sigmoid, torch.sin, torch.cos, torch.atan, torch.nn.functional.elu, torch.nn.functional.softplus,
     torch.exp, lambda v: torch.log(v.abs()), lambda v: v**3],
)  # fmt: skip
def test_functions_err_less_than_is_said(function):
    g = torch.Generator().manual_seed(0)
    for size in (1e-6, 1e-2, 1.0, 20.0, 80.0):
        x = (size * (2 * torch.rand(20_000, generator=g) - 1)).float()
        exact = function(x.double())
        error = (function(x).double() - exact).abs()
        assert bool((error <= float32.error_of(exact, exact, *float32.ERRORS["float32_near"]) / 2).all())


def test_errors_of_sums_are_those_of_the_worst_roundings():
    """Every rounding up, one after the other, of positive terms: what no float32 computation exceeds."""
    for terms in (1, 2, 7, 100, 4000):
        worst = (1 + UNIT) ** (terms + 1) - 1
        assert Fraction(float(float32.error_of_sums(torch.tensor(1.0, dtype=torch.float64), terms))) >= worst
        assert Fraction(float(float32.error_of_sums(np.float64(1.0), terms))) <= worst * Fraction(11, 10)


def test_what_underflows_is_within_the_error():
    tiny = 2.0**-130  # subnormal: kept or flushed to 0
    assert float32.error_of(torch.tensor(tiny), torch.tensor(tiny), *float32.ERRORS["float32"]) >= tiny


@pytest.mark.parametrize("size", [2.0**127, math.inf, math.nan])
def test_nothing_is_known_of_what_may_overflow(size):
    x = torch.tensor(size, dtype=torch.float64)
    for error in (float32.error_of(-x, x, *float32.ERRORS["float32"]), float32.error_of_sums(x, 3)):
        assert error == math.inf
    start = Box.around([1e38], [1e36])
    tube = reach(lambda x: (x.float() * 3.0).double(), start, horizon=1)
    assert tube.lower[1, 0] == -math.inf and tube.upper[1, 0] == math.inf


def test_numbers_beside_float32_values_are_float32():
    tube = reach(lambda x: (x.float() * 0.1).double(), Box.around([2.0**20], [0.0]), horizon=1)
    assert tube.lower[1, 0] <= 2.0**20 * float(np.float32(0.1)) <= tube.upper[1, 0]
    assert tube.lower[1, 0] > 2.0**20 * 0.1 - 1e-1


def kinds(step, n=2):
    x = torch.linspace(0.3, 0.7, n, dtype=torch.float64)
    return record(lambda x, w: step(x), x, torch.zeros(1, dtype=torch.float64)).kinds


def test_what_rounds_is_in_the_program_and_what_moves_is_not():
    moved = kinds(lambda x: torch.relu(torch.flip(x.float(), [0]).clamp(-1, 1).abs().neg()).double())
    assert moved.count("float32") == 1  # the conversion
    assert kinds(lambda x: (x.float() + 1).double()).count("float32") == 2
    assert "float32_near" in kinds(lambda x: torch.tanh(x.float()).double())
    assert "float32_linear" in kinds(lambda x: (x.float() @ torch.ones(2, 2)).double())
    assert "float32_linear" in kinds(lambda x: x.float().sum(-1, keepdim=True).expand(2).double())
    ones = torch.ones(2, 2)
    for cast in (lambda x: x.to(torch.float32), lambda x: x.to(ones), lambda x: x.type_as(ones)):
        assert "float32_linear" in kinds(lambda x, cast=cast: (cast(x) @ ones).double())


def test_a_float64_value_beside_float32_ones_is_computed_in_float64_where_torch_does_so():
    assert kinds(lambda x: x + x.float()).count("float32") == 1
    assert kinds(lambda x: torch.stack([x[0], x.float()[1].double()])).count("float32") == 1


def assigned(x):
    y = torch.zeros_like(x.float())
    y[0] = x[0]
    return y.double()


def subnormal(x):
    return (x.float() * 1e-40).double()


@pytest.mark.parametrize(
    ("step", "words"),
    [
        (lambda x: (x.float() * x[0]).double(), "mixes float32 and float64"),
        (assigned, "mixes float32 and float64"),
        (lambda x: torch.hypot(x.float(), x.float()).double(), "'hypot' is not known in float32"),
        (lambda x: torch.tan(x.float()).double(), "'tan' is not known in float32"),
        (lambda x: (x.float() * np.ones(2, np.float32)).double(), "numpy array"),
        (subnormal, "no normal number of float32"),
        (lambda x: (x.float() * 1e39).double(), "no normal number of float32"),
        (lambda x: x.half().double(), "conversion to torch.float16"),
        (lambda x: torch.add(x.float(), torch.ones(2), alpha=0.1).double(), "from constants alone"),
        (lambda x: (x.float().abs() ** 0.3).double(), "which is no float32 number"),
        (
            lambda x: torch.pow(x.float().abs(), torch.tensor(0.3, dtype=torch.float64)).double(),
            "which is no float32 number",
        ),
        (lambda x: torch.nn.functional.softplus(x.float(), threshold=100.0).double(), "may overflow"),
    ],
)
def test_what_is_not_known_in_float32_is_refused(step, words):
    with pytest.raises((UnsupportedOperationError, UsageError), match=words):
        kinds(step)


def test_lirpa_refuses_float32():
    with pytest.raises(UnsupportedOperationError, match="does not enclose float32"):
        reach(looped(layers()), Box.around([0.0, 0.0, 0.0], [0.1, 0.1, 0.1]), horizon=1, propagator=AutoLirpa())


def test_limits_beside_float32_values_are_float32():
    tube = reach(lambda x: x.float().clamp(-0.1, 0.1).double(), Box.around([0.1], [0.1]), horizon=1)
    assert tube.upper[1, 0] == float(np.float32(0.1)) != 0.1


def test_products_of_float32_values_round_whatever_the_example():
    x = torch.tensor([1.0, 2.0], dtype=torch.float64)  # of which nothing is rounded

    def step(x, w):
        h = x.float()
        return ((h[:, None] * h[None, :]) @ h).double()

    found = [i.kind for i in record(step, x, torch.zeros(1, dtype=torch.float64)).instructions]
    assert found.count("mul") == 2 and found.count("float32") == 1 + found.count("mul") and "float32_linear" in found


def test_truth_values_in_float32_are_computed_with_in_float32():
    tube = reach(lambda x: ((x > 0).float() * 0.1).double(), Box.around([1.0], [0.5]), horizon=1)
    assert tube.lower[1, 0] <= float(np.float32(0.1)) <= tube.upper[1, 0]


def test_products_of_float32_and_float64_values_are_float64_as_torch_makes_them():
    assert kinds(lambda x: x.float().sum() * x).count("float32") == 1


def test_comparisons_and_choices_of_float32_values():
    def step(x):
        h = x.float() * 2.0
        return torch.where(h > 0.2, h, 0.1).double()

    found = kinds(step)
    assert found.count("float32") == 3 and "where" in found  # a difference whose sign no rounding changes
    for x, after in ((0.3, 0.6), (0.05, float(np.float32(0.1)))):
        tube = reach(step, Box(torch.tensor([x]).double(), torch.tensor([x]).double()), horizon=1)
        assert tube.lower[1, 0] <= after <= tube.upper[1, 0] < tube.lower[1, 0] + 1e-6
