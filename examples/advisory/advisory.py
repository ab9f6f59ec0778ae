"""An aircraft that climbs away from another one by advisories: the largest output of a network says which.

The state is the height above the intruder (ft) and the rate of climb (ft/s); a step is a second. A network, evaluated
in float32, scores three advisories: climb at 41.7 ft/s, climb at 25 ft/s, level off. The pilot follows within 8 ft/s^2.

    sagemp prove examples/advisory/advisory.py:step --start 50:150,-5:5 --disturbance -1:1 --horizon 20 \\
        --goal 300:900,-10:50 --names height,rate --units ft,ft/s --dt 1
"""

import torch

from sagemp_cli.reachability.decisions import choose

RATES = torch.tensor([[2500.0 / 60], [1500.0 / 60], [0.0]], dtype=torch.float64)
"""What the advisories ask for (ft/s)."""


def scores() -> torch.nn.Sequential:
    """A network in place of a table of advisories: strong below 300 ft, weak from there to 600 ft, level above."""
    first, second = torch.nn.Linear(2, 3), torch.nn.Linear(3, 3)
    with torch.no_grad():
        first.weight.copy_(torch.tensor([[0.01, 0.0], [0.01, 0.0], [-0.01, 0.0]]))
        first.bias.copy_(torch.tensor([0.0, -6.0, 0.0]))
        second.weight.copy_(torch.tensor([[-1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, -1.0]]))
        second.bias.copy_(torch.tensor([3.0, 0.0, -0.01]))
    return torch.nn.Sequential(first, torch.nn.ReLU(), second).requires_grad_(False)


NETWORK = scores()


def step(x, w):
    """The next height and rate."""
    height, rate = x[..., 0], x[..., 1]
    wanted = choose(NETWORK(x.float()), RATES)[..., 0]
    acceleration = torch.clamp(wanted - rate, -8.0, 8.0)
    return torch.stack([height + rate + 0.5 * acceleration, rate + acceleration + w[..., 0]], dim=-1)
