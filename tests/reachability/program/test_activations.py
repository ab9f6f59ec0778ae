"""Every activation of torch.nn, and functions near them, as programs that do what torch does."""

import math

import pytest
import torch
from torch import nn

from sagemp_cli.reachability import reach
from sagemp_cli.reachability.program.loops import record
from sagemp_cli.sets import Box

ZERO = torch.zeros(1, dtype=torch.float64)
MODULES = [
    nn.ELU(), nn.ELU(0.5), nn.ELU(2.0), nn.ELU(0.0), nn.SELU(), nn.CELU(), nn.CELU(2.0), nn.GELU(), nn.GELU("tanh"),
    nn.SiLU(),
    nn.Mish(), nn.Softplus(), nn.Softplus(3.0, 5.0), nn.Softsign(), nn.Sigmoid(), nn.LogSigmoid(), nn.Tanh(),
    nn.Hardtanh(), nn.Hardsigmoid(), nn.Hardswish(), nn.ReLU(), nn.ReLU6(), nn.LeakyReLU(), nn.LeakyReLU(2.0),
    nn.PReLU(), nn.RReLU().eval(), nn.Softshrink(), nn.Tanhshrink(), nn.GLU(), nn.Identity(),
]  # fmt: skip
CHANNELS = nn.PReLU(4, init=1.7).double()
FUNCTIONS = {
    "a slope of each channel": lambda x: CHANNELS(x.reshape(-1, 4)).reshape(x.shape),
    "floor": torch.floor,
    "ceil": torch.ceil,
    "round": torch.round,
    "trunc": torch.trunc,
    "frac": torch.frac,
    "sign": torch.sign,
    "floor division": lambda x: x // 0.3,
    "remainder": lambda x: x % 0.7,
    "remainder of a negative number": lambda x: torch.remainder(x, -0.7),
    "remainder of a tensor": lambda x: torch.remainder(x, torch.tensor([0.7], dtype=torch.float64)),
    "fmod": lambda x: torch.fmod(x, -0.7),
    "angle that is wrapped": lambda x: (x + math.pi) % (2 * math.pi) - math.pi,
    "erf": torch.erf,
    "erfc": torch.erfc,
    "expm1": torch.expm1,
    "log1p": lambda x: torch.log1p(x + 4),
    "sinh": torch.sinh,
    "cosh": torch.cosh,
    "rsqrt": lambda x: torch.rsqrt(x + 4),
    "power": lambda x: (x + 4) ** 1.3,
    "root of a power": lambda x: (x + 4) ** -0.5,
}
CALLS = [(repr(m), m.double()) for m in MODULES] + list(FUNCTIONS.items())


@pytest.mark.parametrize(("name", "call"), CALLS, ids=[name for name, _ in CALLS])
def test_a_program_does_what_torch_does(name, call):
    x = 2 * torch.randn(200, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).clamp(-1.9, 1.9)
    with torch.no_grad():
        program = record(lambda x, w: (torch.zeros_like(x), call(x)), x[0], ZERO)
        torch.testing.assert_close(program.run(x, ZERO).control, call(x), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("propagator", ["affine", "crown"])
def test_steps_of_activations_are_bounded_and_compared_with_what_they_do(propagator):
    """As :func:`reach` compares every step with its program, beside thresholds too."""
    layers = [m for m in MODULES if not isinstance(m, nn.GLU)]

    def step(x, w):
        return 0.5 * x + 0.02 * torch.stack([layer(x) for layer in layers]).sum(0) + 0.1 * torch.round(4 * x) / 4

    with torch.no_grad():
        tube = reach(step, Box.around([0.3, -0.2, 1.1, -2.0], [0.1] * 4), horizon=3, propagator=propagator)
    assert bool(torch.isfinite(tube.width).all())


def test_sine_and_cosine_of_one_value_are_the_angle_less_whole_turns():
    program = record(lambda x, w: torch.atan2(torch.sin(x), torch.cos(x)), torch.tensor([3.0, 4.0]).double(), ZERO)
    assert program.kinds[2:] == ("wrap",)
    program = record(lambda x, w: torch.atan2(torch.sin(x), torch.cos(x.flip(0))), torch.zeros(2).double(), ZERO)
    assert "atan2" in program.kinds


@pytest.mark.parametrize("wrap", [FUNCTIONS["angle that is wrapped"], lambda x: torch.atan2(x.sin(), x.cos())])
@pytest.mark.parametrize("propagator", ["interval", "affine", "crown"])
def test_an_angle_that_stays_within_a_turn_keeps_its_width_and_else_has_the_whole_circle(wrap, propagator):
    near, far = (
        reach(lambda x, w: wrap(x), Box.around([center], [0.25]), horizon=1, propagator=propagator)
        for center in (7.0, math.pi)
    )
    assert near.lower[1].item() == pytest.approx(6.75 - 2 * math.pi, abs=1e-12)
    assert near.upper[1].item() == pytest.approx(7.25 - 2 * math.pi, abs=1e-12)
    assert far.lower[1].item() == pytest.approx(-math.pi, abs=1e-12)
    assert far.upper[1].item() == pytest.approx(math.pi, abs=1e-12)


def test_an_actuator_with_steps_costs_half_of_one_and_no_more():
    """A feedback that is rounded to a tenth: its error is like a disturbance of a twentieth."""
    tube = reach(lambda x, w: x - 0.5 * torch.round(10 * x) / 10, Box.around([2.0], [0.5]), horizon=60)
    plain = reach(lambda x, w: x - 0.5 * (x + w), Box.around([2.0], [0.5]), Box.around([0.0], [0.05]), horizon=60)
    assert float(tube.width[-1]) <= 1.01 * float(plain.width[-1])
