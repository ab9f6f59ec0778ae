"""What writes into a set in place is refused, since views of the set would not change with it."""

from __future__ import annotations

import pytest
import torch
from torch.nn import functional as F  # noqa: N812

from sagemp_cli.errors import UnsupportedOperationError
from sagemp_cli.reachability.interval.form import IntervalForm


def added(x):
    x += 1.0
    return x


def scaled(x):
    x *= 2.0
    return x


def assigned(x):
    x[..., 0] = 0.0
    return x


WRITES = {
    "sin_": lambda x: x.sin_(),
    "add_": lambda x: x.add_(1.0),
    "clamp_": lambda x: torch.clamp_(x, 0.0, 1.0),
    "relu": lambda x: F.relu(x, inplace=True),
    "relu by position": lambda x: F.relu(x, True),
    "leaky_relu": lambda x: F.leaky_relu(x, 0.1, True),
    "hardtanh": lambda x: F.hardtanh(x, -1.0, 1.0, True),
    "module": torch.nn.ReLU(inplace=True),
    "+=": added,
    "*=": scaled,
    "x[..., 0] =": assigned,
}


@pytest.mark.parametrize("name", WRITES)
def test_what_writes_in_place_is_refused(name):
    x = IntervalForm(torch.zeros(2, dtype=torch.float64), torch.ones(2, dtype=torch.float64))
    with pytest.raises(UnsupportedOperationError, match="in place"):
        WRITES[name](x)
