"""The network along time."""

import pytest
import torch

from sagemp_cli.errors import ConfigError
from sagemp_cli.planners.temporal_network import TemporalNetwork


def network(**changes):
    made = TemporalNetwork(**({"inputs": 3, "outputs": 2, "condition": 4, "width": 8} | changes))
    made.reset(torch.Generator().manual_seed(0))
    return made


def inputs(rows, count=2):
    g = torch.Generator().manual_seed(1)
    return (
        torch.randn(count, rows, 3, generator=g),
        torch.rand(count, generator=g),
        torch.randn(count, 4, generator=g),
    )


@pytest.mark.parametrize("rows", [1, 4, 5, 20, 101])
def test_any_number_of_rows_is_answered_row_by_row(rows):
    made = network()
    x, t, condition = inputs(rows)
    answer = made(x, t, condition)
    assert answer.shape == (2, rows, 2) and bool(torch.isfinite(answer).all())
    alone = made(x[1:], t[1:], condition[1:])
    assert torch.allclose(answer[1:], alone, atol=1e-5)


def test_everything_that_goes_in_matters():
    made = network()
    x, t, condition = inputs(20)
    answer = made(x, t, condition)
    for changed in ((x + 1, t, condition), (x, t + 0.3, condition), (x, t, condition + 1)):
        assert (made(*changed) - answer).abs().amin() > 0


def test_the_first_and_the_last_row_see_each_other():
    made = network()
    x, t, condition = inputs(20)
    x.requires_grad_()
    made(x, t, condition)[0, 0].sum().backward()
    assert x.grad[0, -1].abs().max() > 0 and x.grad[1].abs().max() == 0


def test_there_are_about_a_million_parameters_at_the_default_width():
    count = sum(p.numel() for p in TemporalNetwork(12, 6, condition=12).parameters())
    assert 0.9e6 < count < 1.3e6


def test_weights_follow_from_the_generator():
    first, second = network(), network()
    second.reset(torch.Generator().manual_seed(1))
    x = inputs(8)
    assert not torch.equal(first(*x), second(*x))
    second.reset(torch.Generator().manual_seed(0))
    assert torch.equal(first(*x), second(*x))


def test_wrong_sizes_are_named():
    with pytest.raises(ConfigError, match="width and frequencies must be positive and kernel odd, found 8, 8 and 4"):
        network(kernel=4)
