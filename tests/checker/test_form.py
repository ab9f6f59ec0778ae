import numpy as np
import pytest
import torch
from flint import arb, ctx

from sagemp_cli.checker.balls import Unproved
from sagemp_cli.checker.form import Form, Step, array_of
from sagemp_cli.checker.zonotope import Zonotope
from sagemp_cli.errors import UnsupportedOperationError


@pytest.fixture(autouse=True)
def precision():
    with ctx.workprec(128):
        yield


def make(record=(), lower=(1.0, -0.5), upper=(1.5, 0.5)):
    step = Step(Zonotope.box(lower, upper), [arb(0)], [arb(0)], record)
    return step, step.state()


def bounds(step, form):
    return [(float(a), float(b)) for a, b in step.bounds(form.rows())]


LINEAR = {
    "sums": lambda x: x[..., 0] + 2.0 * x[..., 1] - 1,
    "subtraction from a number": lambda x: 3.0 - x[..., 0],
    "subtraction from a tensor": lambda x: torch.tensor([3.0, 1.0]) - x,
    "product with a tensor": lambda x: torch.tensor([3.0, -1.0]) * x,
    "division by a number": lambda x: (x / 4.0)[..., 0],
    "negation": lambda x: -x,
    "stack": lambda x: torch.stack([x[..., 1], x[..., 0] * 0.5], dim=-1),
    "cat": lambda x: torch.cat([x, x[..., :1] - 1.0], dim=-1),
    "linear layer": lambda x: torch.nn.functional.linear(x, torch.tensor([[1.0, 2.0], [0.5, -3.0]]), torch.ones(2)),
    "zeroth and first power": lambda x: torch.cat([x**0, x**1], dim=-1),
}


@pytest.mark.parametrize("name", LINEAR)
def test_linear_operations_are_exact(name):
    f = LINEAR[name]
    step, x = make()
    corners = torch.tensor([[a, b] for a in (1.0, 1.5) for b in (-0.5, 0.5)])
    values = np.stack([f(c).numpy().reshape(-1) for c in corners])
    found = bounds(step, f(x))
    np.testing.assert_allclose([b[0] for b in found], values.min(0), atol=1e-12)
    np.testing.assert_allclose([b[1] for b in found], values.max(0), atol=1e-12)
    step.finish(f(x))


NONLINEAR = {
    "sin": (lambda x: torch.sin(x[..., 0]), [("sin", 1)]),
    "a method": (lambda x: x[..., 0].cos(), [("cos", 1)]),
    "product": (lambda x: x[..., 0] * x[..., 1], [("product", 1)]),
    "square of itself": (lambda x: x[..., 1] * x[..., 1], [("product", 1)]),
    "quotient": (lambda x: x[..., 1] / x[..., 0], [("reciprocal", 1), ("product", 1)]),
    "power": (lambda x: x[..., 0] ** 3, [("pow(3)", 1)]),
    "clamp": (lambda x: torch.clamp(x, min=0.0, max=1.25), [("clamp", 2)]),
    "maximum": (lambda x: torch.maximum(x[..., 0] - 1.2, x[..., 1]), [("relu", 1)]),
    "minimum": (lambda x: torch.minimum(x[..., 0] - 1.2, x[..., 1]), [("relu", 1)]),
    "leaky ReLU": (lambda x: torch.nn.functional.leaky_relu(x, 0.2), [("leaky_relu", 2)]),
}


@pytest.mark.parametrize("name", NONLINEAR)
@pytest.mark.parametrize("slope", [0.3, 1.7])
def test_whatever_is_recorded_every_value_is_enclosed(name, slope):
    f, operations = NONLINEAR[name]
    record = [(operation, [(slope, 0.1, 1e3)] * width) for operation, width in operations]
    step, x = make(record)
    form = f(x)
    assert step.finish(form).ncols() == 4 + sum(width for _, width in operations)
    grid = torch.cartesian_prod(torch.linspace(1, 1.5, 21), torch.linspace(-0.5, 0.5, 21)).double()
    values = np.stack([f(p).numpy().reshape(-1) for p in grid])
    for (low, high), column in zip(bounds(step, form), values.T, strict=True):
        assert low - 1e-12 <= column.min() and column.max() <= high + 1e-12


@pytest.mark.parametrize("name", NONLINEAR)
def test_a_recorded_radius_that_is_too_small_is_found_out(name):
    f, operations = NONLINEAR[name]
    record = [(operation, [(0.3, 0.1, 1e-6)] * width) for operation, width in operations]
    step, x = make(record)
    with pytest.raises(Unproved, match="a recorded relaxation of '.*' is wrong"):
        f(x)


def test_the_record_must_be_of_what_the_loop_does():
    step, x = make([("cos", [(0.0, 0.0, 9.0)])])
    with pytest.raises(Unproved, match="the loop has 1 x 'sin' where 1 x 'cos' is recorded"):
        torch.sin(x[..., 0])
    step, x = make()
    with pytest.raises(Unproved, match="the loop has 2 x 'sin' where 0 x 'nothing' is recorded"):
        torch.sin(x)
    step, x = make([("sin", [(0.0, 0.0, 9.0)])])
    with pytest.raises(Unproved, match="a relaxation of 'sin' is recorded that the loop does not use"):
        step.finish(x)


@pytest.mark.parametrize("operation", [torch.erf, torch.floor, lambda x: torch.where(x, 1.0, 2.0), lambda x: x.round()])
def test_an_unknown_operation_is_an_error_that_names_it(operation):
    _, x = make()
    with pytest.raises(
        UnsupportedOperationError, match="is unknown to the checker; add it in sagemp_cli/checker/form.py"
    ):
        operation(x)


def test_at_a_point_everything_is_evaluated_as_it_is():
    step = Step(None, [arb(0)], [arb(0)])
    x = Form(step, array_of([step.constant(arb(2)), step.constant(arb(-3))]))
    y = torch.stack([torch.sin(x[..., 0]) * x[..., 1], torch.relu(x[..., 1]), x[..., 1] / x[..., 0]], dim=-1)
    found = [float(s.row[0, 0]) for s in y.values]
    np.testing.assert_allclose(found, [-3 * np.sin(2), 0, -1.5], rtol=1e-14)
