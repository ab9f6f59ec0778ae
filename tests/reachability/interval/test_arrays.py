"""Programs give the same boxes on arrays as on tensors, whatever their operations."""

import pytest
import torch

from sagemp_cli.reachability.interval.form import IntervalForm, evaluate, run_on_arrays
from sagemp_cli.reachability.program.loops import record

LAYER = torch.nn.Linear(3, 2, dtype=torch.float64).requires_grad_(False)
STEPS = {
    "sums and products": lambda x: torch.stack([x[0] * x[1] - 2.0 * x[2], x[2] * x[2] + 1.0, x[0] / (4.0 + x[1])]),
    "moves": lambda x: torch.cat([x[[2, 0]] * 0.5, torch.stack([x[1] + 1e-3])]) + x[:1],
    "a layer": lambda x: torch.cat([torch.tanh(LAYER(x)), LAYER(x)[:1] * 3.0]),
    "functions": lambda x: torch.sin(x) + torch.exp(0.1 * x) + torch.sqrt(x * x + 1.0) + torch.reciprocal(x + 9.0),
    "angles": lambda x: torch.atan2(x, 3.0 + x.flip(0)) + torch.maximum(x, -x) + torch.where(x > 0, x, 2 * x),
    "a pole": lambda x: x / (x - 0.3),
}


@pytest.mark.parametrize("name", STEPS)
def test_boxes_are_the_same_to_the_last_bits(name):
    example, generator = torch.tensor([0.3, -0.4, 0.7], dtype=torch.float64), torch.Generator().manual_seed(0)
    program = record(lambda x, w: STEPS[name](x), example, torch.zeros(1, dtype=torch.float64))
    center = torch.randn(2, 20, 3, dtype=torch.float64, generator=generator)
    radius = torch.rand(2, 20, 3, dtype=torch.float64, generator=generator) * 0.2
    state = IntervalForm(center - radius, center + radius)
    nothing = IntervalForm(*[torch.zeros(1, dtype=torch.float64)] * 2)
    expected = program.run(state, nothing, None, evaluate=evaluate).next
    found = run_on_arrays(program, state, nothing, None).next
    for side, other in zip(found.bounds, expected.bounds, strict=True):
        assert isinstance(side, torch.Tensor)
        torch.testing.assert_close(side, other, rtol=1e-13, atol=1e-13)
