"""The affine rules: every value stays in its form, rounding included, and no form is wider than need be."""

import math
from fractions import Fraction

import flint
import numpy as np
import pytest
import torch
from flint import arb
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import nn
from torch.nn import functional

from sagemp_cli.errors import UnsupportedOperationError
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.affine.compiled.operations import Frame, Value
from sagemp_cli.reachability.affine.compiled.run import Steps
from sagemp_cli.reachability.program.loops import RecordedLoop, record
from sagemp_cli.reachability.program.program import Instruction, Outputs, Program
from sagemp_cli.sets import Box
from sagemp_cli.sets.zonotope import Zonotope


class Formed:
    """What a function of ``x in center + generators eps`` and w in a box gives, as forms; cells first."""

    def __init__(self, function, center, generators, w_center=(0.0,), w_radius=(0.0,), *, tensors=False):
        c, g, w, r = (torch.as_tensor(v, dtype=torch.float64) for v in (center, generators, w_center, w_radius))
        self.center, self.generators = (c, g) if c.dim() == 2 else (c[None], g[None])
        program = record(lambda x, w: (x, function(x, w)), self.center[0].detach(), w)
        loop = RecordedLoop((program,), torch.zeros(1, 0, dtype=torch.float64), 1)
        steps = Steps(loop, Box(w - r, w + r), torch.Size([len(self.center)]), tensors=tensors)
        state = Zonotope(self.center, self.generators)
        if not tensors:
            state = Zonotope(state.center.numpy(), state.generators.numpy())
        with np.errstate(all="ignore"):
            done = steps.kept(0, state, (state.low, state.high))
            self.frame, self.value = done.frame, done.form
            self.low, self.high = (torch.as_tensor(side) for side in self.frame.bounds(self.value))
            self.radius = torch.as_tensor(self.frame.reach(self.value))
        self.width = self.high - self.low

    def contains(self, values):
        """Whether values ``(samples, B, e)`` are between the bounds."""
        return bool(((self.low - 1e-15 <= values) & (values <= self.high + 1e-15)).all())

    def points(self, count, seed=2):
        """Points of the set ``(count, B, n)``."""
        generator = torch.Generator().manual_seed(seed)
        signs = torch.rand(count, self.generators.shape[-1], dtype=torch.float64, generator=generator) * 2 - 1
        return self.center + torch.einsum("bnm,sm->sbn", self.generators, signs)


def drawn(cells=3, n=3, seed=0):
    """Centres and generators."""
    generator = torch.Generator().manual_seed(seed)
    c = torch.randn(cells, n, dtype=torch.float64, generator=generator)
    return c, 0.2 * torch.randn(cells, n, 5, dtype=torch.float64, generator=generator)


DIAGONAL = torch.diag(torch.tensor([0.5, 0.25], dtype=torch.float64))


def test_a_linear_map_has_exactly_the_width_of_the_image():
    layer = nn.Linear(3, 2, dtype=torch.float64).requires_grad_(False)
    y = Formed(lambda x, w: layer(x), *drawn())
    torch.testing.assert_close(torch.as_tensor(y.value.both[0]), layer(y.center), rtol=1e-14, atol=1e-14)
    torch.testing.assert_close(y.radius, (layer.weight @ y.generators).abs().sum(-1), rtol=1e-12, atol=1e-14)


def test_what_cancels_cancels():
    y = Formed(lambda x, w: 2.0 * x - x - x * torch.ones(3, dtype=torch.float64), *drawn())
    assert float(y.width.max()) <= 1e-12


def test_a_quotient_of_equal_operands_is_one():
    y = Formed(lambda x, w: x[0] / x[0], [3.0, 5.0], DIAGONAL)
    assert float(y.low) == pytest.approx(1.0, abs=1e-12) and float(y.high) == pytest.approx(1.0, abs=1e-12)


def test_a_square_written_as_a_product_is_as_tight_as_the_square():
    product, square = (Formed(f, [1.0], [[0.5]]) for f in (lambda x, w: x * x, lambda x, w: x**2))
    assert float(product.radius) == pytest.approx(float(square.radius), rel=1e-9)
    # x^2 is in [0.25, 2.25]; the zonotope encloses it around its parabola's secant: [0, 2.25].
    assert float(product.high) == pytest.approx(2.25, rel=1e-9)


def test_a_product_of_independent_operands_has_the_radius_of_the_box():
    y = Formed(lambda x, w: x[0] * x[1], [2.0, 3.0], DIAGONAL)
    assert float(y.radius) == pytest.approx(2 * 0.25 + 3 * 0.5 + 0.5 * 0.25, rel=1e-9)


def test_operands_that_move_against_each_other_make_a_narrower_product():
    y = Formed(lambda x, w: x[0] * x[1], [2.0, 3.0], [[0.5], [-0.5]])
    apart = Formed(lambda x, w: x[0] * x[1], [2.0, 3.0], 0.5 * torch.eye(2))
    # (2 + h)(3 - h) = 6 + h - h^2, h in [-1/2, 1/2]: [5.25, 6.25]; the form adds at most the box of h^2.
    assert 5.25 - 1e-12 >= float(y.low) >= 5.25 - 1e-9 and 6.25 <= float(y.high) <= 6.5 + 1e-9
    assert float(y.width) < 0.3 * float(apart.width)


def test_constants_are_taken_in_double_precision():
    for function in (lambda x, w: torch.sub(x, 0.1), lambda x, w: x - 0.1, lambda x, w: x.sub(0.1)):
        y = Formed(function, [0.0], [[0.0]])
        low, high = Fraction(float(y.low)), Fraction(float(y.high))
        assert low <= -Fraction(0.1) <= high and high - low < Fraction(1, 10**12)


def test_cells_do_not_influence_each_other():
    def f(x, w):
        return torch.sin(x[0]) * torch.tanh(x[1]) / (2 + x[2] ** 2)

    center, generators = drawn(2)
    both = Formed(f, center, generators)
    for k in range(2):
        alone = Formed(f, center[k], generators[k])
        torch.testing.assert_close(both.low[k], alone.low[0], rtol=1e-9, atol=1e-12)
        torch.testing.assert_close(both.high[k], alone.high[0], rtol=1e-9, atol=1e-12)


def test_an_unbounded_cell_does_not_spoil_the_others():
    y = Formed(lambda x, w: torch.tan(x), [[0.0], [1.5], [0.3]], [[[0.1]], [[0.2]], [[0.1]]])
    finite = torch.isfinite(y.low[..., 0]) & torch.isfinite(y.high[..., 0])
    assert finite.tolist() == [True, False, True]


# -- random expressions --------------------------------------------------------------------------------------------

UNARY = {
    "sin": (torch.sin, lambda x: x.sin()),
    "cos": (torch.cos, lambda x: x.cos()),
    "tanh": (torch.tanh, lambda x: x.tanh()),
    "atan": (torch.atan, lambda x: x.atan()),
    "sigmoid": (torch.sigmoid, lambda x: 1 / (1 + (-x).exp())),
    "silu": (functional.silu, lambda x: x / (1 + (-x).exp())),
    "relu": (torch.relu, lambda x: arb.max(x, arb(0))),
    "leaky relu": (lambda x: functional.leaky_relu(x, 0.1), lambda x: arb.max(x, arb(0.1) * x)),
    "abs": (abs, abs),
    "square": (torch.square, lambda x: x * x),
    "cube": (lambda x: x**3, lambda x: x**3),
    "hardtanh": (functional.hardtanh, lambda x: arb.min(arb.max(x, arb(-1)), arb(1))),
    "clamp": (lambda x: x.clamp(max=0.25), lambda x: arb.min(x, arb(0.25))),
    "reciprocal": (lambda x: 1 / (1 + x * x), lambda x: 1 / (1 + x * x)),
    "sqrt": (lambda x: torch.sqrt(1 + x * x), lambda x: (1 + x * x).sqrt()),
    "exp": (lambda x: torch.exp(torch.sin(x)), lambda x: x.sin().exp()),
    "negative": (lambda x: -x, lambda x: -x),
    "affine": (lambda x: 0.3 * x - 1.7, lambda x: arb(0.3) * x - arb(1.7)),
}
BINARY = {
    "add": (lambda a, b: a + b, lambda a, b: a + b),
    "subtract": (lambda a, b: a - b, lambda a, b: a - b),
    "multiply": (lambda a, b: a * b, lambda a, b: a * b),
    "divide": (lambda a, b: a / (2 + torch.cos(b)), lambda a, b: a / (2 + b.cos())),
    "maximum": (torch.maximum, arb.max),
    "minimum": (torch.minimum, arb.min),
    "atan2": (lambda a, b: torch.atan2(a, 1.5 + torch.sin(b)), lambda a, b: (a / (arb(1.5) + b.sin())).atan()),
}
TREES = st.recursive(
    st.sampled_from(["x", "y", "w"]),
    lambda inner: st.one_of(
        st.tuples(st.sampled_from(sorted(UNARY)), inner),
        st.tuples(st.sampled_from(sorted(BINARY)), inner, inner),
    ),
    max_leaves=6,
)


def evaluate(tree, leaves: dict, which: int):
    """The tree's value in torch (which = 0) or in ball arithmetic (which = 1)."""
    if isinstance(tree, str):
        return leaves[tree]
    operation = UNARY.get(tree[0]) or BINARY[tree[0]]
    return operation[which](*(evaluate(branch, leaves, which) for branch in tree[1:]))


@pytest.mark.parametrize("tensors", [False, True], ids=["arrays", "tensors"])
@given(
    tree=TREES,
    center=st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-1, 1)),
    size=st.sampled_from([0.0, 1e-9, 1e-3, 0.1, 0.7]),
    seed=st.integers(0, 2**20),
)
@settings(max_examples=100, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
def test_a_random_expression_stays_in_its_form(tensors, tree, center, size, seed):
    generator = torch.Generator().manual_seed(seed)
    g = size * torch.randn(2, 4, dtype=torch.float64, generator=generator)

    def function(x, w):
        return evaluate(tree, {"x": x[..., 0], "y": x[..., 1], "w": w[..., 0]}, 0)

    form = Formed(function, center[:2], g, center[2:], [size], tensors=tensors)
    low, high = float(form.low), float(form.high)
    signs = torch.rand(24, 5, dtype=torch.float64, generator=generator) * 2 - 1
    signs[:16] = signs[:16].sign()
    before, flint.ctx.prec = flint.ctx.prec, 200
    try:
        for row in signs.tolist():
            state = [
                arb(c) + sum(arb(v) * arb(e) for v, e in zip(line, row[:4], strict=True))
                for c, line in zip(center[:2], g.tolist(), strict=True)
            ]
            leaves = {"x": state[0], "y": state[1], "w": arb(center[2]) + arb(size) * arb(row[4])}
            value = evaluate(tree, leaves, 1)
            assert math.isnan(low) or math.isnan(high) or arb(low) <= value <= arb(high)
    finally:
        flint.ctx.prec = before


@pytest.mark.parametrize("name", ["leaky relu", "abs", "multiply", "maximum"])
def test_a_form_whose_errors_are_shrunk_is_caught(name, monkeypatch):
    def escaped() -> bool:
        operation, count = (UNARY.get(name) or BINARY[name])[0], 1 if name in UNARY else 2
        y = Formed(lambda x, w: operation(*x[:count]), [0.0, 0.0], 0.7 * torch.eye(2).double())
        grid = torch.linspace(-0.7, 0.7, 141, dtype=torch.float64)
        values = operation(*torch.meshgrid(grid, grid, indexing="ij")[:count])
        return float(values.min()) < float(y.low) - 1e-12 or float(values.max()) > float(y.high) + 1e-12

    assert not escaped()
    honest = Frame.result
    monkeypatch.setattr(
        Frame,
        "result",
        lambda self, relaxed, *others: honest(self, relaxed._replace(radius=relaxed.radius * 0.9), *others),
    )
    assert escaped()


@pytest.mark.parametrize("quarter", range(8))
def test_atan2_encloses_the_angle_in_every_direction(quarter):
    angle = quarter * math.pi / 4 + 0.2
    center, generators = [math.cos(angle), math.sin(angle)], [[0.05, 0.02], [-0.03, 0.06]]
    form = Formed(lambda x, w: torch.atan2(x[1], x[0]), center, generators)
    points = form.points(500, seed=1)
    angles = torch.atan2(points[..., 1], points[..., 0])[..., None]
    assert form.contains(angles)
    assert float(form.width) <= 1.15 * float(angles.max() - angles.min())


def test_atan2_across_its_jump_is_the_whole_circle():
    form = Formed(lambda x, w: torch.atan2(x[1], x[0]), [-1.0, 0.0], 0.1 * torch.eye(2).double())
    assert -3.2 < float(form.low) <= -math.pi and math.pi <= float(form.high) < 3.2


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("lgamma", torch.lgamma),
        ("acos", torch.acos),
        ("erfinv", lambda x: x.erfinv()),
    ],
)
def test_an_unsupported_operation_is_named_with_the_place_to_add_it(name, call):
    with pytest.raises(UnsupportedOperationError) as error:
        Formed(lambda x, w: call(x), *drawn())
    assert str(error.value) == (
        f"torch operation '{name}' has no relaxation in the native propagators (affine, crown, interval); "
        "add one in sagemp_cli/reachability/relaxations and register it in its registry.py"
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda x: x if x[0] > 0 else -x, "a step may not branch on a value"),
        (lambda x: bool((x == 0)[0]), "a step may not branch on a value"),
        (lambda x: bool(x[0]), "a step may not branch on a value"),
        (lambda x: x ** float("inf"), "torch operation 'pow' is supported with a finite exponent, found inf"),
        (lambda x: 2**x, "torch operation 'pow' is supported with a number as exponent"),
        (lambda x: functional.elu(x, alpha=-0.5), "elu is supported with an alpha of at least 0, found -0.5"),
        (lambda x: functional.rrelu(x, training=True), "rrelu is random in training mode"),
        (lambda x: x % 0.0, "'remainder' is supported with one number other than 0 as divisor, found 0.0"),
        (lambda x: 2.0 % x, "'remainder' is supported with a number as divisor"),
        (lambda x: torch.round(x, decimals=2), "'round(decimals=2)' has no relaxation"),
        (lambda x: functional.softplus(x, beta=-1.0), "softplus is supported with a positive beta, found -1.0"),
    ],
)
def test_what_is_supported_in_part_says_which_part(call, message):
    with pytest.raises(UnsupportedOperationError) as error:
        Formed(lambda x, w: call(x), *drawn())
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "module",
    [
        nn.ReLU(),
        nn.LeakyReLU(0.2),
        nn.ReLU6(),
        nn.Hardtanh(-0.5, 0.5),
        nn.Tanh(),
        nn.Sigmoid(),
        nn.Softplus(beta=2.0),
        nn.SiLU(),
        nn.ELU(),
    ],
    ids=str,
)
def test_activation_modules_enclose_their_own_outputs(module):
    y = Formed(lambda x, w: module(x), *drawn())
    assert y.contains(module(y.points(200)))


@pytest.mark.parametrize(
    "clamped",
    [
        lambda x: torch.clamp(x, -0.2, 0.3),
        lambda x: x.clamp(min=-0.2),
        lambda x: x.clip(max=0.3),
        lambda x: x.clamp_min(0.1).clamp_max(torch.tensor(0.2)),
        lambda x: torch.clamp(x, torch.tensor([-0.1, -0.2, 0.0]), torch.tensor([0.1, 0.2, 0.3])),
        lambda x: torch.clamp(x, -(x[..., :1] ** 2), x[..., 1:2] * 0.5 + 1.0),
        lambda x: torch.minimum(torch.tensor(0.3), torch.maximum(x, torch.tensor(-0.2))),
        lambda x: torch.max(torch.min(x, torch.tensor(0.3)), torch.tensor(-0.2)),
    ],
)
def test_clamp_takes_numbers_tensors_and_values_on_either_side(clamped):
    y = Formed(lambda x, w: clamped(x), *drawn(2))
    assert y.contains(clamped(y.points(300)))


def test_training_gets_finite_gradients_also_from_points():
    def f(x, w):
        v = functional.leaky_relu(x[1], 0.1)
        return v * torch.cos(x[0]) + v * torch.sin(x[0])

    center = torch.tensor([[0.0, 0.0], [1.0, -2.0]], dtype=torch.float64, requires_grad=True)
    for size in (0.0, 0.3):
        g = (size * torch.eye(2, dtype=torch.float64)).expand(2, 2, 2).clone().requires_grad_(True)
        y = Formed(f, center, g, tensors=True)
        for gradient in torch.autograd.grad(y.radius.sum() + y.value.both[0].sum(), (center, g)):
            assert bool(torch.isfinite(gradient).all())


def test_a_value_is_read_in_terms_of_all_symbols_by_its_bounds():
    y = Formed(lambda x, w: x + w, [1.0], [[0.5, -0.25]], [2.0], [0.125])
    assert isinstance(y.value, Value)
    assert float(y.low) == pytest.approx(3 - 0.875, abs=1e-12) and float(y.high) == pytest.approx(3.875, abs=1e-12)


SIZED = {
    "a sine over a period": (lambda x, w: torch.sin(8 * x[0]), [0.0, 0.0]),
    "a product around 0": (lambda x, w: x[0] * x[1], [0.0, 0.0]),
    "a product off 0": (lambda x, w: x[0] * x[1], [2.0, -3.0]),
    "a product with one factor around 0": (lambda x, w: x[0] * x[1], [0.0, 3.0]),
    "a quotient": (lambda x, w: x[0] / x[1], [0.1, -2.0]),
    "a quotient that shares": (lambda x, w: (x[0] + x[1]) / x[1], [1.0, 2.0]),
    "an angle above": (lambda x, w: torch.atan2(x[0], x[1]), [2.0, 0.1]),
    "an angle to the left": (lambda x, w: torch.atan2(x[0], x[1]), [0.8, -2.0]),
    "a chain": (lambda x, w: torch.exp(x[0] * torch.cos(3 * x[1])) - torch.tanh(x[1]), [0.3, 0.1]),
}


@pytest.mark.parametrize("name", SIZED)
@pytest.mark.parametrize("tensors", [False, True])
def test_the_magnitude_that_rounding_is_counted_by_is_at_least_what_a_value_can_be(name, tensors):
    y = Formed(SIZED[name][0], SIZED[name][1], DIAGONAL, tensors=tensors)
    met = [(relaxed.name, relaxed.form) for relaxed in y.frame.relaxed] + [("the result", y.value)]
    for what, form in met:
        center, magnitude = (torch.as_tensor(part) for part in form.both)
        largest = center.abs() + torch.as_tensor(y.frame.radius(form.coefficients))
        assert bool((magnitude >= largest * (1 - 1e-12)).all()), what
    for f in (relaxed.factors for relaxed in y.frame.relaxed if relaxed.factors is not None):
        scaled = f.radius_x * f.scale + f.radius_y / f.scale
        assert bool((torch.as_tensor(f.magnitude) >= torch.as_tensor(scaled) * (1 - 1e-12)).all())


RELAXED = {
    "clamp": [lambda x, w: torch.maximum(x, torch.tensor(0.2)), lambda x, w: torch.minimum(torch.tensor(0.2), x)],
    "relu": [lambda x, w: torch.maximum(x[0], x[1]), lambda x, w: torch.minimum(x[0], x[1]), lambda x, w: x.relu()],
    "product": [lambda x, w: x[0] * x[1]],
    "reciprocal": [lambda x, w: 2.0 / x],
    "reciprocal product": [lambda x, w: x[0] / x[1]],
    "atan2": [lambda x, w: torch.atan2(x[0], x[1])],
    "": [lambda x, w: 2.0 * x, lambda x, w: x / 3.0, lambda x, w: torch.cat([x - w, -x])],
}
"""Which relaxations a step has, as the specification of programs says."""


@pytest.mark.parametrize("names", RELAXED)
def test_an_operation_has_the_relaxations_of_the_specification(names):
    for function in RELAXED[names]:
        found = Formed(function, [2.0, 3.0], DIAGONAL).frame.relaxed
        assert " ".join(relaxed.name for relaxed in found) == names


@pytest.mark.parametrize("function", [lambda x, w: torch.sin(x), lambda x, w: x[0] * x[1], lambda x, w: torch.exp(x)])
def test_what_is_of_second_order_is_added_to_the_radius_of_a_band(function):
    (relaxed,) = Formed(function, [1.0, 2.0], DIAGONAL).frame.relaxed
    assert bool((torch.as_tensor(relaxed.radius) >= torch.as_tensor(relaxed.band.radius) * (1 + 0.999e-9)).all())


@pytest.mark.parametrize("kind", ["maximum", "minimum"])
@pytest.mark.parametrize("order", [(0, 2), (2, 0)])
def test_a_stored_limit_by_a_number_is_a_clamp(kind, order):
    limit = (torch.tensor([0.2, -0.1], dtype=torch.float64),)
    inputs = Instruction("state", 2), Instruction("disturbance", 1), Instruction("constant", 2, (), limit)
    loop = RecordedLoop((Program((*inputs, Instruction(kind, 2, order)), Outputs(3)),), torch.zeros(1, 0).double(), 1)
    start, w = Box.around([0.0, 0.0], [0.5, 0.5]), Box.around([0.0], [0.0])
    run = Affine().run(loop, start, w, keep_steps=True)
    assert [relaxed.name for relaxed in run.steps[0].relaxed] == ["clamp"]
    ends = [getattr(torch, kind)(side, limit[0]) for side in (start.lower, start.upper)]
    assert bool((run.tube.lower[1] <= ends[0]).all()) and bool((ends[1] <= run.tube.upper[1]).all())


def test_what_underflows_is_still_enclosed():
    for function in (lambda x, w: (x * 1e-200) * 1e-200, lambda x, w: (x / 1e200) / 1e200):
        y = Formed(function, [1.0], [[0.5]])
        assert float(y.low) <= 0.0 < float(y.high) and y.value.both[1].item() > 0.0
