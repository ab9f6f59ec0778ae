"""A program that is not the step is found out, wherever the difference lies and however small it is."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
import torch

from sagemp_cli.errors import UsageError
from sagemp_cli.reachability import reach
from sagemp_cli.sets import Box

START, DISTURBANCE = Box.around([0.5, 0.2], [0.5, 0.2]), Box.around([0.0], [0.1])


def recorded(x):
    """Whether it is being recorded: what no step may ask."""
    return type(x).__name__ == "Traced"


def bump(v, at, width):
    return torch.clamp(1.0 - (v - at).abs() / width, 0.0, 1.0)


def other_than_recorded(difference, base=lambda x: 0.9 * x):
    return lambda x, w: base(x) + 0.1 * w + (0.0 if recorded(x) else difference(x))


HIDDEN = {
    "a corner": (other_than_recorded(lambda x: 1e3 * torch.relu(x[..., :1] - (1.0 - 1e-6))), {}),
    "the centre": (other_than_recorded(lambda x: bump(x[..., :1], 0.5, 1e-6)), {}),
    "a cell": (other_than_recorded(lambda x: bump(x[..., :1], 0.125, 1e-6)), {"partitions": [8, 1]}),
    "last bits": (other_than_recorded(lambda x: 1e-13), {}),
    "a threshold": (
        other_than_recorded(
            lambda x: 0.1 * bump(x[..., :1], 0.3337, 1e-5), base=lambda x: 0.5 * torch.clamp(x, max=0.3337)
        ),
        {},
    ),
    "a threshold of one state only": (
        other_than_recorded(
            lambda x: 0.1 * bump(x[..., :1], 0.3337, 1e-5),
            base=lambda x: 0.5 * torch.clamp(x, max=torch.tensor([0.3337, math.inf], dtype=torch.float64)),
        ),
        {},
    ),
    "up the gradient": (other_than_recorded(lambda x: torch.relu(x[..., :1] + x[..., 1:] - 1.35)), {}),
    "a later step": (
        other_than_recorded(lambda x: torch.relu(x[..., :1] - 1.5), base=lambda x: 1.1 * x),
        {"horizon": 9},
    ),
}


@pytest.mark.parametrize("batched", [True, None, False])
@pytest.mark.parametrize("name", HIDDEN)
def test_a_difference_is_found(name, batched):
    step, options = HIDDEN[name]
    with pytest.raises(UsageError, match="differs from what it did when it was recorded"):
        reach(step, START, DISTURBANCE, **({"horizon": 2, "batched": batched} | options))


class Late:
    """Another step from its ``after``-th call on."""

    def __init__(self, after):
        self.calls, self.after = 0, after

    def __call__(self, x, w):
        self.calls += 1
        return 0.9 * x + (0.01 if self.calls > self.after else 0.0)


@pytest.mark.parametrize("after", [30, 60, 90])
def test_a_step_that_changes_after_some_calls_is_refused(after):
    with pytest.raises(UsageError):
        reach(Late(after), START, DISTURBANCE, 2)


RARE = {
    "torch": lambda x, w: 0.9 * x if torch.rand(()) < 0.9999 else 0.8 * x,
    "python": lambda x, w: 0.9 * x if random.random() < 0.9999 else 0.8 * x,
    "numpy": lambda x, w: 0.9 * x if np.random.rand() < 0.9999 else 0.8 * x,  # noqa: NPY002
}


@pytest.mark.parametrize("name", RARE)
def test_a_branch_that_is_rarely_taken_at_random_is_refused(name):
    with pytest.raises(UsageError, match="draws random numbers|another result|does not always"):
        reach(RARE[name], START, DISTURBANCE, 2)
