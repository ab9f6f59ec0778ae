"""Networks that planners share."""

import pytest
import torch

from sagemp_cli.errors import ConfigError
from sagemp_cli.planners.networks import TimeMLP


@pytest.fixture
def network():
    made = TimeMLP(3, 2, hidden=[16, 8], frequencies=2, dtype=torch.float64)
    made.reset(torch.Generator().manual_seed(0))
    return made


def test_batches_and_single_vectors_agree(network):
    x, t = torch.randn(4, 5, 3, dtype=torch.float64), torch.rand(4, 5, dtype=torch.float64)
    whole = network(x, t)
    assert whole.shape == (4, 5, 2)
    assert torch.allclose(whole[2, 3], network(x[2, 3], t[2, 3]), atol=1e-14)
    assert torch.allclose(network(x, t[0, 0])[2, 3], network(x[2, 3], t[0, 0]), atol=1e-14)


def test_the_output_depends_on_vector_and_time(network):
    x = torch.zeros(3, dtype=torch.float64)
    start, end = network(x, torch.tensor(0.0).double()), network(x, torch.tensor(1.0).double())
    assert not torch.allclose(start, end)
    assert not torch.allclose(start, network(x + 1, torch.tensor(0.0).double()))


def test_weights_follow_from_the_generator(network):
    x, t = torch.randn(7, 3, dtype=torch.float64), torch.rand(7, dtype=torch.float64)
    first = network(x, t)
    network.reset(torch.Generator().manual_seed(1))
    second = network(x, t)
    network.reset(torch.Generator().manual_seed(0))
    assert torch.equal(network(x, t), first) and not torch.equal(second, first)


def test_wrong_widths_are_named():
    with pytest.raises(ConfigError, match=r"hidden widths must be positive .* found \[8, 0\] and 2"):
        TimeMLP(3, 2, hidden=[8, 0], frequencies=2)
