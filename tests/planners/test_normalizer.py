"""Normalisation of states."""

import pytest
import torch

from sagemp_cli.errors import NonFiniteError, UsageError
from sagemp_cli.planners.normalizer import Normalizer


@pytest.fixture
def data():
    generator = torch.Generator().manual_seed(1)
    spread = torch.tensor([3.0, 1e-3, 40.0], dtype=torch.float64)
    return 7.0 + spread * torch.randn(50, 20, 3, dtype=torch.float64, generator=generator)


def test_normalised_data_have_zero_mean_and_unit_spread(data):
    z = Normalizer(3).fit(data).normalize(data).flatten(0, 1)
    assert torch.allclose(z.mean(0), torch.zeros(3, dtype=torch.float64), atol=1e-9)
    assert torch.allclose(z.std(0, correction=0), torch.ones(3, dtype=torch.float64))


def test_there_and_back_is_the_identity(data):
    normalizer = Normalizer(3).fit(data)
    assert torch.allclose(normalizer.denormalize(normalizer.normalize(data)), data, rtol=1e-14)


def test_an_unfitted_normalizer_is_the_identity(data):
    assert torch.equal(Normalizer(3).normalize(data), data)


def test_a_constant_dimension_is_only_shifted(data):
    data[..., 1] = 0.1  # the mean of many 0.1 is not exactly 0.1
    normalizer = Normalizer(3).fit(data)
    assert normalizer.scale[1] == 1.0
    assert normalizer.normalize(data)[..., 1].abs().max() < 1e-12


def test_the_fit_travels_with_the_state_dict(data):
    normalizer, other = Normalizer(3).fit(data), Normalizer(3)
    other.load_state_dict(normalizer.state_dict())
    assert torch.equal(other.normalize(data), normalizer.normalize(data))


def test_wrong_data_are_named(data):
    with pytest.raises(UsageError, match=r"needs data of shape \(\.\.\., 2\), found \(50, 20, 3\)"):
        Normalizer(2).fit(data)
    data[0, 0, 0] = float("nan")
    with pytest.raises(NonFiniteError, match="contain NaN or infinity"):
        Normalizer(3).fit(data)
