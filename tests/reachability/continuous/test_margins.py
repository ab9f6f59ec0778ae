"""Bounds of functions of the state hold along every solution, at the instants and over whole parts."""

import pytest
import torch

from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.continuous.margins import along, observable
from sagemp_cli.reachability.continuous.reach import reach_continuously
from sagemp_cli.reachability.continuous.sampled import sampled
from sagemp_cli.sets import Box


class Loop:
    horizon, state_dim, period = 10, 2, 0.2

    def numbers(self):
        return torch.zeros(self.horizon, 0, dtype=torch.float64)

    def control_given(self, numbers, x):
        return (-2 * x[..., :1] - x[..., 1:]).clamp(-1.0, 1.0)

    def rate(self, x, u):
        return torch.cat([x[..., 1:], torch.sin(x[..., :1]) + 3 * u], -1)


FUNCTIONS = {
    "linear": lambda x: torch.cat([x[..., :1] - 0.3 * x[..., 1:], -x[..., 1:]], -1),
    "norm": lambda x: torch.sqrt(x[..., :1] ** 2 + x[..., 1:] ** 2 + 0.01),
    "kinked": lambda x: torch.abs(x[..., :1]) - x[..., 1:],
}


@pytest.mark.parametrize("shape", FUNCTIONS)
@pytest.mark.parametrize("size", [0.0, 0.3])
def test_no_solution_has_a_smaller_value(shape, size):
    start = Box(torch.tensor([[0.2, -0.1]]).double(), torch.tensor([[0.3, 0.1]]).double())
    w = Box(torch.tensor([-0.1, -1.0]).double() * size, torch.tensor([0.1, 1.0]).double() * size)
    loop = sampled(Loop(), start)
    reach = reach_continuously(Affine(), loop, start, w, substeps=2, order=2)
    g = observable(FUNCTIONS[shape], loop, start.center[0], shape)
    assert (g.change is None) == (shape == "kinked")
    controls = reach.control_lower, reach.control_upper
    at_ends, over = along(g, loop, reach.flow, reach.tube, controls, w)
    generator, fine = torch.Generator().manual_seed(0), 40
    x = torch.where(torch.rand(64, 2, generator=generator) < 0.5, start.lower, start.upper)
    nothing, h, values = torch.zeros_like(x), Loop.period / fine, [FUNCTIONS[shape](x)]
    for k in range(loop.horizon):
        u = loop.control.run(x, nothing, None).control
        for i in range(fine):
            if i % 5 == 0:
                v = torch.where(torch.rand(64, 2, generator=generator) < 0.5, w.lower, w.upper)
            rate = lambda y, u=u, v=v: loop.rate.run(y, nothing, u).next + v  # noqa: E731
            a = rate(x)
            b = rate(x + h / 2 * a)
            c = rate(x + h / 2 * b)
            x = x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c))
            values.append(FUNCTIONS[shape](x))
    seen = torch.stack(values, 1)  # (64, K fine + 1, c)
    per = fine // 2
    assert bool((seen[:, ::per].amin(0) >= at_ends[0] - 1e-9).all())
    pieces = torch.stack([seen[:, i : seen.shape[1] - per + i : per] for i in range(per + 1)]).amin((0, 1))
    assert bool((pieces >= over[0] - 1e-9).all())
    # and they are bounds worth having
    assert float((pieces - over[0]).amax()) < 0.35


def test_between_the_instants_a_smooth_function_is_bounded_by_the_chord_and_its_bulge():
    """A straight line of which the box over a part says nothing good: the chord is exact."""

    class Straight(Loop):
        def control_given(self, numbers, x):
            return 0 * x[..., :1]

        def rate(self, x, u):
            return torch.cat([1 + 0 * x[..., :1] + 0 * u, 1 + 0 * x[..., :1]], -1)

    start = Box(torch.zeros(1, 2).double(), torch.zeros(1, 2).double())
    w = Box(torch.zeros(2).double(), torch.zeros(2).double())
    loop = sampled(Straight(), start)
    reach = reach_continuously(Affine(), loop, start, w, substeps=1, order=2)
    g = observable(lambda x: x[..., :1] - x[..., 1:], loop, start.center[0], "difference")
    _, over = along(g, loop, reach.flow, reach.tube, (reach.control_lower, reach.control_upper), w)
    assert float(over.amin()) > -1e-6  # the difference of the boxes is -0.2


@pytest.mark.parametrize("speed", [1.0, -1.0])
def test_an_angle_that_jumps_within_a_part_is_not_bounded_by_its_rate_of_change(speed):
    """Half a turn within a period, across the cut from pi to -pi: no line from either end knows of the jump."""

    class Turning(Loop):
        horizon, period = 2, 0.4

        def control_given(self, numbers, x):
            return 0.0 * x[..., :1]

        def rate(self, x, u):
            return torch.cat([-speed * x[..., 1:], speed * x[..., :1]], -1) + 0.0 * u

    angle = torch.tensor(torch.pi - 0.2 * speed).double() * (1.0 if speed > 0 else -1.0)
    x = torch.stack([torch.cos(angle), torch.sin(angle)])
    start, still = Box(x[None] - 1e-3, x[None] + 1e-3), Box(torch.zeros(2).double(), torch.zeros(2).double())
    loop = sampled(Turning(), start)
    reach = reach_continuously(Affine(), loop, start, still, substeps=1, order=4)
    for sign, after in ((1.0, torch.clone), (-1.0, torch.clone), (1.0, torch.tanh), (-1.0, torch.tanh)):
        g = observable(lambda x, s=sign, f=after: s * f(torch.atan2(x[..., 1:], x[..., :1]) * 1), loop, x, "angle")
        _, over = along(g, loop, reach.flow, reach.tube, (reach.control_lower, reach.control_upper), still)
        times = torch.linspace(0, Turning.period, 400).double()
        turned = angle + speed * times
        least = (sign * after(torch.atan2(torch.sin(turned), torch.cos(turned)))).amin()
        assert float(over[0, 0, 0]) <= float(least) + 1e-9
