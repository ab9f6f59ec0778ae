"""Folding a step into matrices: exact up to the rounding it claims."""

from dataclasses import dataclass
from fractions import Fraction

import pytest
import torch

from sagemp_cli.errors import UsageError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.affine.compiled.folding import compiled
from sagemp_cli.reachability.program.loops import record
from sagemp_cli.sets import Box

from ..propagator_cases import DISTURBANCE, START, line, unicycle_loop


def folded(function):
    """A step function of numbers ``(3,)``, two states and two disturbances, compiled."""
    x, p = torch.tensor([0.3, -0.2]).double(), torch.tensor([0.5, -1.0, 2.0]).double()
    return compiled(record(lambda x, w, p: function(p, x, w), x, x, p))


A = torch.tensor([[0.3, -0.7], [0.1, 0.9], [1.3, 0.2]], dtype=torch.float64)
B = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)


def every_linear_operation(p, x, w):
    y = torch.nn.functional.linear(x, A, B) - p / 3.0
    y = torch.cat([y * B, 0.5 - w, torch.tensor([4.0]) * x[..., :1]], dim=-1)
    a, b, c, d, e, f = y.unbind(-1)
    z = torch.stack([a + b, -c, d - 2.0 * e, f], dim=-1).unsqueeze(-2)
    grid = (z + torch.ones(3, 1, dtype=torch.float64) * 0.1)[..., 1:, :]
    total = grid.sum(-2) @ torch.cat([A, A[:1]]) + torch.squeeze(z[..., :2], -2) / B[:2]
    return total + torch.flatten(grid, -2)[..., 3:5] - torch.tensor(0.7)


def test_linear_operations_give_the_matrix_of_the_function_they_make_up():
    state = folded(every_linear_operation).outputs.next
    generator = torch.Generator().manual_seed(0)
    v = torch.randn(50, 7, dtype=torch.float64, generator=generator)
    expected = every_linear_operation(v[:, :3], v[:, 3:5], v[:, 5:])
    found = state.matrix[:, 0] + v @ state.matrix[:, 1:].T
    torch.testing.assert_close(found, expected, rtol=1e-13, atol=1e-13)
    assert bool((state.sizes >= state.matrix.abs() * (1 - 1e-12)).all())


def test_the_error_claimed_is_above_the_true_one_and_not_far_above():
    generator = torch.Generator().manual_seed(1)
    weights = [torch.randn(2, 2, dtype=torch.float64, generator=generator) for _ in range(12)]

    def function(p, x, w):
        for weight in weights:
            x = torch.nn.functional.linear(x, weight, p[..., :2] * 0.1) / 3.0 - 0.7 * x
        return x + w * 0.0

    state = folded(function).outputs.next
    exact = [[Fraction(int(i == j)) for j in range(2)] for i in range(2)]
    for weight in weights:
        w = [[Fraction(v) for v in row] for row in weight.tolist()]
        exact = [
            [sum(w[i][m] * exact[m][j] for m in range(2)) / 3 - Fraction(0.7) * exact[i][j] for j in range(2)]
            for i in range(2)
        ]
    for i in range(2):
        for j in range(2):
            error = abs(Fraction(state.matrix[i, 4 + j].item()) - exact[i][j])
            assert 0 < error <= Fraction(state.error) * Fraction(state.sizes[i, 4 + j].item())
    assert state.error < 12 * 20 * 2.0**-53


def test_nonlinear_operations_are_noted_in_the_order_of_evaluation():
    def function(p, x, w):
        a, b = torch.sin(x), torch.relu(x[..., :1] * p[..., :1])
        return a * b + x / (2.0 + torch.cos(w))

    found = folded(function)
    assert [(n.rule, n.relaxation and n.relaxation.name, n.size) for n in found.nodes] == [
        ("function", "sin", 2),
        ("product", None, 1),
        ("function", "relu", 1),
        ("product", None, 2),
        ("function", "cos", 2),
        ("function", "reciprocal", 2),
        ("quotient", None, 2),
    ]
    assert found.columns == [0, 1, 4, 6, 8, 10, 11, 12, 14, 16, 18, 20]
    assert found.outputs.next.matrix.shape[-1] == found.columns[-1]


def test_an_extreme_of_a_constant_is_a_clamp_and_of_two_values_a_relu():
    def function(p, x, w):
        return torch.maximum(x, torch.tensor([-0.25, 0.5]).double()) + torch.minimum(x, w)

    first, second = folded(function).nodes
    assert (first.relaxation.name, second.relaxation.name) == ("clamp", "relu")
    assert [limit.tolist() for limit in first.relaxation.parameters] == [[-0.25, 0.5], [torch.inf] * 2]


class Windy(ClosedLoop):
    """A closed loop with a step of its own, which what it inherits knows nothing of."""

    def step(self, k, x, w):
        return super().step(k, x, w) + 0.3 * k


def test_a_loop_that_overrides_its_step_is_bounded_as_it_steps():
    loop, start, disturbance = unicycle_loop(line(0.1)), START, DISTURBANCE
    windy = Windy(loop.dynamics, loop.tracker, loop.references)
    with torch.no_grad():
        tube = Affine().propagate(windy, start, disturbance)
        x = start.center
        for k in range(windy.horizon):
            x = windy.step(k, x, disturbance.center)
            assert bool(((tube.lower[k + 1] <= x) & (x <= tube.upper[k + 1])).all())
    with pytest.raises(UsageError, match="Windy has a step of its own"):
        Affine().reach(windy, start, disturbance, watch=True)


@dataclass(frozen=True)
class Drift:
    """A step that adds a scaled constant of less precision."""

    number: torch.Tensor
    horizon: int = 5
    state_dim: int = 2

    def step(self, k, x, w):
        return torch.add(x, self.number, alpha=0.1) + w


def test_a_scaled_constant_of_less_precision_is_taken_exactly():
    number = torch.tensor(0.1, dtype=torch.float32)
    point = Box.around([1.0, 1.0], [0.0, 0.0])
    tube = Affine().propagate(Drift(number), point, Box.around([0.0, 0.0], [0.0, 0.0]))
    exact = 1 + 5 * Fraction(0.1) * Fraction(float(number))
    assert Fraction(float(tube.lower[5, 0])) <= exact <= Fraction(float(tube.upper[5, 0]))
