"""Folding a step into matrices: exact up to the rounding it claims."""

from dataclasses import dataclass
from fractions import Fraction
from typing import ClassVar

import pytest
import torch

from sagemp_cli.errors import UnsupportedOperationError, UsageError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.affine.compiled.foldable_loop import FoldableLoop, NotFoldable
from sagemp_cli.reachability.affine.compiled.folding import plan_of
from sagemp_cli.sets import Box

from ..propagator_cases import DISTURBANCE, START, line, unicycle_loop


@dataclass(frozen=True)
class Step:
    """A loop of one step function of given numbers ``(3,)``, two states and two disturbances."""

    function: object
    given_dim: ClassVar[int] = 1

    def given(self, k):
        return torch.tensor([0.5, -1.0, k], dtype=torch.float64)

    def step_given(self, given, x, w):
        return self.function(given, x, w), None


def plan(function):
    return plan_of(Step(function), torch.Size([3]), 2, 2)


A = torch.tensor([[0.3, -0.7], [0.1, 0.9], [1.3, 0.2]], dtype=torch.float64)
B = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)


def every_linear_operation(p, x, w):
    y = torch.nn.functional.linear(x, A, B) - p / 3.0
    y = torch.cat([y * B, 0.5 - w, torch.tensor([4.0])[None] * x[..., :1]], dim=-1)
    a, b, c, d, e, f = y.unbind(-1)
    z = torch.stack([a + b, -c, d - 2.0 * e, f], dim=-1).unsqueeze(-2)
    grid = (z + torch.ones(3, 1, dtype=torch.float64) * 0.1)[..., 1:, :]
    total = grid.sum(-2) @ torch.cat([A, A[:1]]) + torch.squeeze(z[..., :2], -2) / B[:2]
    return total + torch.flatten(grid, -2)[..., 3:5] - torch.tensor(0.7)


def test_linear_operations_give_the_matrix_of_the_function_they_make_up():
    state = plan(every_linear_operation).state
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

    state = plan(function).state
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

    found = plan(function)
    assert [(n.kind, n.name, n.size) for n in found.nodes] == [
        ("scalar", "sin", 2),
        ("product", "", 1),
        ("scalar", "relu", 1),
        ("product", "", 2),
        ("scalar", "cos", 2),
        ("scalar", "reciprocal", 2),
        ("quotient", "", 2),
    ]
    assert [part.shape[-1] for part in found.split(found.state.matrix)] == [1, 3, 2, 2, 2, 1, 1, 2, 2, 2, 2]


def test_what_is_no_state_cannot_be_folded():
    with pytest.raises(NotFoldable):
        plan(lambda p, x, w: x[..., 0])  # not a state


def test_an_operation_that_nothing_is_known_of_is_refused_by_name():
    with pytest.raises(UnsupportedOperationError, match="torch operation 'erf' has no relaxation"):
        plan(lambda p, x, w: torch.erf(x))
    with pytest.raises(UnsupportedOperationError, match="sum.*over one dimension, found dim=None"):
        plan(lambda p, x, w: x * torch.sum(x))


def test_a_loop_says_itself_that_it_can_be_folded():
    assert isinstance(Step(None), FoldableLoop) and not isinstance(object(), FoldableLoop)


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


class Sum:
    """A step that counts its dimensions from the front."""

    horizon, state_dim, given_dim = 5, 2, 0

    def given(self, k):
        return torch.zeros((), dtype=torch.float64)

    def step_given(self, given, x, w):
        return 0.5 * x + x.sum(0) + w, None

    def step(self, k, x, w):
        return self.step_given(self.given(k), x, w)[0]


def test_a_step_that_counts_dimensions_from_the_front_is_not_folded():
    start = Box.around([1.0, 2.0], [0.1, 0.1])
    loop = Sum()
    with torch.no_grad():
        tube = Affine().propagate(loop, start, Box.around([0.0, 0.0], [0.1, 0.1]))
        x = start.center
        for k in range(loop.horizon):
            x = loop.step(k, x, torch.zeros(2, dtype=torch.float64))
            assert bool(((tube.lower[k + 1] <= x) & (x <= tube.upper[k + 1])).all())


def test_a_scaled_constant_of_less_precision_is_taken_exactly():
    number = torch.tensor(0.1, dtype=torch.float32)

    class Drift(Sum):
        def step_given(self, given, x, w):
            return torch.add(x, number, alpha=0.1) + w, None

    tube = Affine().propagate(Drift(), Box.around([1.0, 1.0], [0.0, 0.0]), Box.around([0.0, 0.0], [0.0, 0.0]))
    exact = 1 + 5 * Fraction(0.1) * Fraction(float(number))
    assert Fraction(float(tube.lower[5, 0])) <= exact <= Fraction(float(tube.upper[5, 0]))
