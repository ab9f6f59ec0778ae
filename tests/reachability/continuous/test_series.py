"""Taylor coefficients of a program's values are those of the flow, whatever the operations."""

import pytest
import torch

from sagemp_cli.errors import UnsupportedOperationError
from sagemp_cli.reachability.continuous.series import state_coefficients
from sagemp_cli.reachability.continuous.writing import Writer
from sagemp_cli.reachability.program.loops import record

RATES = {
    "sin and cos": lambda x: torch.stack([torch.sin(x[1]) * x[0], torch.cos(x[1]) - x[0]]),
    "exp and log": lambda x: torch.stack([torch.exp(-x[0]) + x[1], torch.log(x[0] + 2)]),
    "sqrt": lambda x: torch.stack([torch.sqrt(x[1] * x[1] + 1), torch.sqrt(x[0] + 1)]),
    "quotients": lambda x: torch.stack([x[0] / (1 + x[1] * x[1]), 1 / (x[0] + 2)]),
    "reciprocal": lambda x: torch.reciprocal(x + 1.5),
    "tanh and tan": lambda x: torch.stack([torch.tanh(x[0] * x[1]), torch.tan(0.5 * x[0])]),
    "sigmoid and silu": lambda x: torch.stack([torch.sigmoid(x[1]), torch.nn.functional.silu(x[0])]),
    "atan": lambda x: torch.stack([torch.atan(x[1]), torch.atan(x[0] * 2)]),
    "atan2": lambda x: torch.stack([torch.atan2(x[0], 1 + x[1]), -x[0]]),
    "powers": lambda x: torch.stack([x[1] ** 3 - x[0] ** 5, x[0] ** 2]),
    "powers that are not whole": lambda x: torch.stack([(x[0] + 1.5) ** 1.5, (x[1] + 2) ** -0.7]),
    "gelu in its tanh form": lambda x: torch.nn.functional.gelu(x * 1.5, approximate="tanh"),
    "what is left of periods": lambda x: torch.stack([torch.remainder(x[1] + 5, 2.0), torch.fmod(x[0] * x[1], 3.0)]),
    "sums of exponentials": lambda x: torch.stack([torch.logaddexp(x[0], 2 * x[1]), torch.logaddexp(x[1], 0 * x[0])]),
    "a wrapped angle": lambda x: torch.stack([torch.atan2(torch.sin(x[1]), torch.cos(x[1])), x[0]]),
    "negative powers": lambda x: torch.stack([(x[0] + 1.5) ** -2, (x[1] + 2) ** -3]),
    "constant": lambda x: torch.stack([x[1], torch.tensor(-9.81, dtype=torch.float64) + 0 * x[0]]),
    "one entry with all": lambda x: x * x[:1] - x[1:] + 1,
}


@pytest.mark.parametrize("name", RATES)
def test_coefficients_are_the_derivatives_of_the_flow(name):
    rate, w = RATES[name], torch.tensor([0.2, -0.1], dtype=torch.float64)
    x0 = torch.tensor([0.3, 0.4], dtype=torch.float64)
    program = record(lambda x, w: rate(x), x0, torch.zeros(2, dtype=torch.float64))
    out, order = Writer(2, 2), 4
    found = state_coefficients(out, program, out.state, None, out.disturbance, order)
    zeros = out.constant([0.0, 0.0])
    step = out.finished(next=out.state, control=out.join(*(zeros if c is None else c for c in found)))
    values = step.run(x0, w).control.reshape(order + 1, 2)

    def derivative(g):  # along the flow
        def along(x):
            x = x if x.requires_grad else x.clone().requires_grad_()
            (slope,) = torch.autograd.functional.jvp(g, (x,), (rate(x) + w,), create_graph=True)[1:]
            return slope

        return along

    expected, g, factorial = [x0], (lambda x: rate(x) + w), 1.0
    for q in range(1, order + 1):
        factorial *= q
        expected.append(g(x0).detach() / factorial)
        g = derivative(g)
    torch.testing.assert_close(values, torch.stack(expected), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("name", ["gelu", "erf", "mish"])
def test_a_rate_without_written_derivatives_is_refused_by_name(name):
    function = getattr(torch, name, None) or getattr(torch.nn.functional, name)
    x0 = torch.tensor([0.3, 0.4], dtype=torch.float64)
    program, out = record(lambda x, w: function(x), x0, torch.zeros(2, dtype=torch.float64)), Writer(2, 2)
    with pytest.raises(UnsupportedOperationError, match=f"'{name}' stands in .* no derivatives in time"):
        state_coefficients(out, program, out.state, None, None, 1)


@pytest.mark.parametrize("kink", [torch.relu, torch.abs, lambda x: x.clamp(-1, 1)])
def test_a_rate_with_a_kink_is_refused_by_name(kink):
    x0 = torch.tensor([0.3, 0.4], dtype=torch.float64)
    program = record(lambda x, w: kink(x), x0, torch.zeros(2, dtype=torch.float64))
    out = Writer(2, 2)
    with pytest.raises(UnsupportedOperationError, match="relu|abs|clamp"):
        state_coefficients(out, program, out.state, None, None, 1)
