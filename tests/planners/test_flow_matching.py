"""Flow matching: integrators, the loss's minimiser, and the flow that it gives."""

import numpy as np
import pytest
import torch

from sagemp_cli.planners import FlowMatching
from sagemp_cli.planners.flow_matching import FlowMatchingLoss, integrate
from sagemp_cli.sets import Box


@pytest.mark.parametrize(("method", "order"), [("euler", 1), ("midpoint", 2), ("heun", 2), ("rk4", 4)])
def test_an_integration_has_the_order_of_its_method(method, order):
    """``dz/dt = A z + t b``, whose solution is an exponential of the system extended by t and 1."""
    A = torch.tensor([[-1.0, 3.0], [-3.0, -0.5]], dtype=torch.float64)
    b, z = torch.tensor([1.0, -2.0], dtype=torch.float64), torch.tensor([0.7, -0.4], dtype=torch.float64)
    system = torch.zeros(4, 4, dtype=torch.float64)
    system[:2, :2], system[:2, 2], system[2, 3] = A, b, 1.0
    exact = (torch.linalg.matrix_exp(system) @ torch.cat([z, torch.tensor([0.0, 1.0]).double()]))[:2]
    steps = [16, 32, 64, 128]
    errors = [
        float((integrate(lambda z, t: A @ z + t * b, z, steps=n, method=method) - exact).abs().max()) for n in steps
    ]
    assert -np.polyfit(np.log(steps), np.log(errors), 1)[0] == pytest.approx(order, abs=0.15)


def test_an_integration_ends_where_it_is_told_to():
    z = torch.ones(1, dtype=torch.float64)
    assert integrate(lambda z, t: torch.ones_like(z), z, steps=7, method="rk4", until=0.25) == pytest.approx(1.25)
    assert torch.equal(integrate(lambda z, t: 1 / 0, z, steps=0, method="euler"), z)


class Gaussian(FlowMatching):
    """Answers what is best when knots are normal with mean m and spread s, independently."""

    m, s = 1.5, 0.4

    def answer(self, z, t, conditions):
        t = t[:, None, None]
        return self.m + self.s**2 * t / (t**2 * self.s**2 + (1 - t) ** 2) * (z - t * self.m)


def gaussian(**changes):
    return Gaussian(**({"state_dim": 2, "horizon": 20, "knots": 6, "width": 8, "integration_steps": 40} | changes))


@pytest.mark.parametrize("method", ["euler", "midpoint", "heun", "rk4"])
def test_the_flow_of_the_best_answer_is_the_distribution(method):
    """The flow of a Gaussian is known: noise e goes to ``m + s e``."""
    made = gaussian(method=method)
    e = torch.randn(50, 6, 2, generator=torch.Generator().manual_seed(0))
    knots = made.generate(e, None, generator=torch.Generator())
    assert torch.allclose(knots, made.m + made.s * e, atol=0.15 if method == "euler" else 0.04)


def test_the_error_left_by_few_steps_falls_with_their_number():
    e = torch.randn(50, 6, 2, generator=torch.Generator().manual_seed(0))
    errors = []
    for steps in (5, 10, 20, 40):
        made = gaussian(integration_steps=steps)
        errors.append(float((made.generate(e, None, generator=torch.Generator()) - made.m - made.s * e).abs().max()))
    assert all(later < 0.7 * sooner for sooner, later in zip(errors[:-1], errors[1:], strict=True))


def test_one_step_is_the_networks_answer_to_pure_noise():
    made = gaussian(integration_steps=1)
    e = torch.randn(3, 6, 2, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(made.generate(e, None, generator=torch.Generator()), torch.full((3, 6, 2), made.m))


def test_the_best_answer_has_the_smallest_loss():
    made, m, s = gaussian(), Gaussian.m, Gaussian.s
    goal = Box.around([0.0, 0.0], [1.0, 1.0])
    rows = torch.randn(10, 21, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    made.prepare(rows, goal=goal, generator=torch.Generator().manual_seed(0))
    loss = FlowMatchingLoss(made, rows, steps=1)
    g = torch.Generator().manual_seed(2)
    knots, noise = m + s * torch.randn(4000, 6, 2, generator=g), torch.randn(4000, 6, 2, generator=g)
    u = torch.rand(4000, generator=g)

    def error(**changes):
        for name, value in changes.items():
            setattr(made, name, value)
        return float(loss.error(made, knots, noise, u, None))

    best = error()
    assert error(m=m + 0.1) > best and error(m=m - 0.1) > best
    assert error(m=m, s=0.5) > best and error(s=0.3) > best
    # The same as the error of the velocity, where the weight is not bounded.
    early = u < 0.9
    z = (1 - u)[:, None, None] * noise + u[:, None, None] * knots
    made.s = s
    velocity = (made.answer(z, u, None) - z) / (1 - u)[:, None, None]
    wanted = (velocity - (knots - noise))[early].square().mean()
    assert float(loss.error(made, knots[early], noise[early], u[early], None)) == pytest.approx(float(wanted), rel=1e-4)
