"""Affine forms: exact on linear maps, sound on random expressions, honest about what they cannot do."""

import math
from fractions import Fraction

import flint
import pytest
import torch
from flint import arb
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import nn
from torch.nn import functional

import sagemp_cli.reachability.affine.operations
import sagemp_cli.reachability.relaxations.registry  # noqa: F401  (both register what forms can do)
from sagemp_cli.errors import UnsupportedOperationError
from sagemp_cli.reachability.affine.form import AffineForm, StepFrame


def a_state(center, generators, disturbance_radius=(), disturbance_center=()) -> tuple[AffineForm, AffineForm]:
    """State ``center + generators eps`` and disturbance box, as forms of one frame."""
    c, g = (torch.as_tensor(v, dtype=torch.float64) for v in (center, generators))
    radius = torch.as_tensor(disturbance_radius, dtype=torch.float64)
    frame = StepFrame(g, g.abs().sum(-1) * (1 + 1e-15), radius)
    return frame.state(c), frame.disturbance(torch.as_tensor(disturbance_center, dtype=torch.float64))


def a_batch(*batch: int, n: int = 3, seed: int = 0) -> AffineForm:
    generator = torch.Generator().manual_seed(seed)
    c = torch.randn(*batch, n, dtype=torch.float64, generator=generator)
    g = 0.2 * torch.randn(*batch, n, 5, dtype=torch.float64, generator=generator)
    return a_state(c, g)[0]


def width(form: AffineForm) -> torch.Tensor:
    low, high = form.bounds()
    return high - low


# -- linear operations ---------------------------------------------------------------------------------------------


def test_a_linear_map_has_exactly_the_width_of_the_image():
    x = a_batch(4)
    layer = nn.Linear(3, 2, dtype=torch.float64)
    y = layer(x)
    exact = (layer.weight @ x.frame.generators).abs().sum(-1)
    torch.testing.assert_close(y.center, layer(x.center))
    torch.testing.assert_close(y.radius(), exact, rtol=1e-12, atol=1e-14)


def test_what_cancels_cancels():
    x = a_batch(2)
    y = 2.0 * x - x - x * torch.ones(3, dtype=torch.float64)
    assert float(width(y).max()) <= 1e-12


def test_a_quotient_of_equal_operands_is_one():
    x, _ = a_state([3.0, 5.0], torch.diag(torch.tensor([1.0, 0.2], dtype=torch.float64)))
    low, high = (x[..., 0] / x[..., 0]).bounds()
    assert float(low) == pytest.approx(1.0, abs=1e-12) and float(high) == pytest.approx(1.0, abs=1e-12)


def test_a_square_written_as_a_product_is_as_tight_as_the_square():
    x, _ = a_state([1.0], [[0.5]])
    product, square = x * x, x**2
    assert float(product.radius()) == pytest.approx(float(square.radius()), rel=1e-9)
    # x^2 is in [0.25, 2.25]; the zonotope encloses it around its parabola's secant: [0, 2.25].
    assert float(product.bounds()[1]) == pytest.approx(2.25, rel=1e-9)


def test_a_product_of_independent_operands_has_the_radius_of_the_box():
    x, _ = a_state([2.0, 3.0], torch.diag(torch.tensor([0.5, 0.25], dtype=torch.float64)))
    y = x[..., 0] * x[..., 1]
    assert float(y.radius()) == pytest.approx(2 * 0.25 + 3 * 0.5 + 0.5 * 0.25, rel=1e-9)


def test_operands_that_move_against_each_other_make_a_narrower_product():
    x, _ = a_state([2.0, 3.0], [[0.5], [-0.5]])
    y = x[..., 0] * x[..., 1]
    apart, _ = a_state([2.0, 3.0], torch.diag(torch.tensor([0.5, 0.5], dtype=torch.float64)))
    # (2 + h)(3 - h) = 6 + h - h^2, h in [-1/2, 1/2]: [5.25, 6.25]; the form adds at most the box of h^2.
    low, high = y.bounds()
    assert 5.25 - 1e-12 >= float(low) >= 5.25 - 1e-9 and 6.25 <= float(high) <= 6.5 + 1e-9
    assert float(width(y)) < 0.3 * float(width(apart[..., 0] * apart[..., 1]))


@pytest.mark.parametrize("batch", [(), (3,), (2, 3), (2, 1, 2)], ids=str)
def test_moving_entries_around_agrees_with_tensors_for_every_batch(batch):
    x = a_batch(*batch)
    constant = torch.tensor([1.0, -2.0], dtype=torch.float64)

    def maps(v):
        a, b, c = v.unbind(-1)
        return [
            torch.stack([a, b + c], dim=-1),
            torch.cat([v, 2 * v[..., :1]], dim=-1),
            torch.stack([v, -v], dim=-2).flatten(-2),
            v[..., [2, 0]],
            v[..., 1:].sum(-1),
            v.sum(-1, keepdim=True) + v,
            v[..., None, :] - constant[:, None],
            v.unsqueeze(-1).squeeze(-1),
            v[..., :2] * constant,
            v @ torch.arange(6.0, dtype=torch.float64).reshape(3, 2),
            torch.sub(v, 0.1),
            torch.add(v, v, alpha=0.5),
            1 - v / 3,
        ]

    for form, value in zip(maps(x), maps(x.center), strict=True):
        assert form.shape == value.shape
        torch.testing.assert_close(form.center, value, rtol=1e-14, atol=1e-14)
        low, high = form.bounds()
        assert bool((low <= value).all() and (value <= high).all())


def test_constants_are_taken_in_double_precision():
    x, _ = a_state([0.0], [[0.0]])
    for y in (torch.sub(x, 0.1), x - 0.1, x.sub(0.1)):
        low, high = (Fraction(float(v)) for v in y.bounds())
        assert low <= -Fraction(0.1) <= high
        assert high - low < Fraction(1, 10**12)


def test_batches_do_not_influence_each_other():
    x = a_batch(2, 3)
    for k in range(2):
        one = AffineForm(
            StepFrame(x.frame.generators[k], x.frame.reach[k], x.frame.disturbance_radius),
            x.center[k],
            x.coefficients[:, k],
            x.magnitude[k],
            x.error,
        )

        def f(v):
            return torch.sin(v[..., 0]) * torch.tanh(v[..., 1]) / (2 + v[..., 2] ** 2)

        for both, alone in zip(f(x).bounds(), f(one).bounds(), strict=True):
            torch.testing.assert_close(both[k], alone, rtol=1e-9, atol=1e-12)


def test_an_unbounded_cell_does_not_spoil_the_others():
    x, _ = a_state([[0.0], [1.5], [0.3]], [[[0.1]], [[0.2]], [[0.1]]])
    low, high = torch.tan(x).bounds()
    finite = torch.isfinite(low[..., 0]) & torch.isfinite(high[..., 0])
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
    """The tree's value on forms (which = 0) or in ball arithmetic (which = 1)."""
    if isinstance(tree, str):
        return leaves[tree]
    operation = UNARY.get(tree[0]) or BINARY[tree[0]]
    return operation[which](*(evaluate(branch, leaves, which) for branch in tree[1:]))


@given(
    tree=TREES,
    center=st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-1, 1)),
    size=st.sampled_from([0.0, 1e-9, 1e-3, 0.1, 0.7]),
    seed=st.integers(0, 2**20),
)
@settings(max_examples=150, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
def test_a_random_expression_stays_in_its_form(tree, center, size, seed):
    generator = torch.Generator().manual_seed(seed)
    g = size * torch.randn(2, 4, dtype=torch.float64, generator=generator)
    x, w = a_state(center[:2], g, [size], center[2:])
    form = evaluate(tree, {"x": x[..., 0], "y": x[..., 1], "w": w[..., 0]}, 0)
    low, high = (float(v) for v in form.bounds())
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
        x, _ = a_state([0.0, 0.0], torch.diag(torch.tensor([0.7, 0.7], dtype=torch.float64)))
        operation = (UNARY.get(name) or BINARY[name])[0]
        grid = torch.linspace(-0.7, 0.7, 141, dtype=torch.float64)
        points = torch.meshgrid(grid, grid, indexing="ij")
        count = 1 if name in UNARY else 2
        low, high = operation(*(x[..., i] for i in range(count))).bounds()
        values = operation(*points[:count])
        return float(values.min()) < float(low) - 1e-12 or float(values.max()) > float(high) + 1e-12

    assert not escaped()
    honest = AffineForm.with_fresh
    monkeypatch.setattr(
        AffineForm, "with_fresh", lambda self, c, g, magnitude, radius: honest(self, c, g, magnitude, radius * 0.9)
    )
    assert escaped()


@pytest.mark.parametrize("quarter", range(8))
def test_atan2_encloses_the_angle_in_every_direction(quarter):
    angle = quarter * math.pi / 4 + 0.2
    x, _ = a_state([math.cos(angle), math.sin(angle)], [[0.05, 0.02], [-0.03, 0.06]])
    form = torch.atan2(x[..., 1], x[..., 0])
    low, high = form.bounds()
    signs = torch.rand(500, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 2 - 1
    points = x.center + signs @ x.frame.generators.T
    angles = torch.atan2(points[:, 1], points[:, 0])
    assert bool((low <= angles).all() and (angles <= high).all())
    assert float(high - low) <= 1.15 * float(angles.max() - angles.min())


def test_atan2_across_its_jump_is_the_whole_circle():
    x, _ = a_state([-1.0, 0.0], torch.diag(torch.tensor([0.1, 0.1], dtype=torch.float64)))
    low, high = torch.atan2(x[..., 1], x[..., 0]).bounds()
    assert -3.2 < float(low) <= -math.pi and math.pi <= float(high) < 3.2


# -- what is not supported -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("where", lambda x: torch.where(torch.tensor([True, False, True]), x, x)),
        ("floor", torch.floor),
        ("T", lambda x: x.T),
        ("sign", torch.sign),
        ("linalg_norm", lambda x: torch.linalg.norm(x, dim=-1)),
        ("erf", lambda x: x.erf()),
    ],
)
def test_an_unsupported_operation_is_named_with_the_place_to_add_it(name, call):
    with pytest.raises(UnsupportedOperationError) as error:
        call(a_batch(2))
    assert str(error.value) == (
        f"torch operation '{name}' has no relaxation in the native propagators (affine, crown, interval); "
        "add one in sagemp_cli/reachability/relaxations and register it in its registry.py"
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda x: x if x[..., 0] > 0 else -x, "a step may not branch on a value"),
        (lambda x: x == 0, "a step may not branch on a value"),
        (lambda x: bool(x), "a step may not branch on a value"),
        (lambda x: x[0].sin(), "has lost the batch dimensions (2,)"),
        (lambda x: x.sum(), "torch operation 'sum' is supported over one dimension, found dim=None"),
        (lambda x: x**1.5, "torch operation 'pow' is supported with integers and 0.5, found 1.5"),
        (lambda x: 2**x, "torch operation 'pow' is supported with a number as exponent"),
        (lambda x: functional.leaky_relu(x, 2.0), "negative_slope of at most 1, found 2.0"),
        (lambda x: functional.elu(x, alpha=0.5), "elu is supported with alpha 1, found 0.5"),
        (lambda x: functional.softplus(x, beta=-1.0), "softplus is supported with a positive beta, found -1.0"),
        (lambda x: x.max(-1), "torch operation 'max' is supported with two operands (torch.maximum)"),
        (lambda x: x @ torch.zeros(3), "x @ W with a constant two-dimensional W"),
    ],
)
def test_what_is_supported_in_part_says_which_part(call, message):
    with pytest.raises(UnsupportedOperationError) as error:
        call(a_batch(2))
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
    x = a_batch(3)
    low, high = module(x).bounds()
    signs = torch.rand(200, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(2)) * 2 - 1
    points = x.center + torch.einsum("bnm,sm->sbn", x.frame.generators, signs)
    values = module(points)
    assert bool((low - 1e-15 <= values).all() and (values <= high + 1e-15).all())


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
def test_clamp_takes_numbers_tensors_and_forms_on_either_side(clamped):
    x = a_batch(2)
    low, high = clamped(x).bounds()
    signs = torch.rand(300, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(2)) * 2 - 1
    points = x.center + torch.einsum("bnm,sm->sbn", x.frame.generators, signs)
    values = clamped(points)
    assert bool((low - 1e-15 <= values).all() and (values <= high + 1e-15).all())


def test_training_gets_finite_gradients_also_from_points():
    center = torch.tensor([[0.0, 0.0], [1.0, -2.0]], dtype=torch.float64, requires_grad=True)
    for size in (0.0, 0.3):
        g = (size * torch.eye(2, dtype=torch.float64)).expand(2, 2, 2).clone().requires_grad_(True)
        frame = StepFrame(g, g.abs().sum(-1), torch.zeros(0, dtype=torch.float64))
        x = frame.state(center)
        v = functional.leaky_relu(x[..., 1], 0.1)
        y = v * torch.cos(x[..., 0]) + v * torch.sin(x[..., 0])
        for gradient in torch.autograd.grad(y.radius().sum() + y.center.sum(), (center, g)):
            assert bool(torch.isfinite(gradient).all())
