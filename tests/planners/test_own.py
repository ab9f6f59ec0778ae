"""Anybody's planner: a function is enough, and what it gives is checked."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from sagemp_cli.errors import NonFiniteError, UsageError
from sagemp_cli.planners import Planner
from sagemp_cli.planners.own import OwnPlanner
from sagemp_cli.scenes.scene import Scene
from sagemp_cli.sets import Box

SCENE = Scene(Box(torch.zeros(2), torch.ones(2)), (), Box(torch.zeros(3), torch.ones(3)))
START = torch.tensor([1.0, 2.0, 0.5], dtype=torch.float64)


def sample(planner, *, start=START, count=4):
    own = OwnPlanner(planner, name="waltz", state_names=("px", "py", "theta"), horizon=5)
    return own.sample(start, SCENE.goal, scene=SCENE, count=count, generator=torch.Generator())


def still(start, goal, scene, count, generator):
    return start[:, None].expand(count, 6, 3).clone()


def changed(where, value):
    def plan(start, goal, scene, count, generator):
        plans = still(start, goal, scene, count, generator)
        plans[where] = value
        return plans

    return plan


def test_a_function_is_a_planner():
    plans = sample(still)
    assert plans.shape == (4, 6, 3) and plans.dtype == torch.float64
    assert isinstance(OwnPlanner(still, name="waltz", state_names=("px",), horizon=5), Planner)
    each = torch.arange(12.0, dtype=torch.float64).reshape(4, 3)
    assert torch.equal(sample(still, start=each)[:, 0], each)


def test_so_is_an_object_with_sample_and_what_gives_arrays_of_float32():
    class Waltz(nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = nn.Parameter(torch.ones(2))

        def sample(self, start, goal, *, scene, count, generator):
            return np.asarray(still(start, goal, scene, count, generator), dtype=np.float32)

    assert torch.equal(sample(Waltz())[:, 3], START.expand(4, 3))
    own = OwnPlanner(Waltz(), name="waltz", state_names=("px", "py", "theta"), horizon=5)
    assert list(own.state_dict()) == ["planner.weight"]


def fails(start, goal, scene, count, generator):
    raise ZeroDivisionError("nothing left")


def wrong_words(a, b):
    return a


@pytest.mark.parametrize(
    ("planner", "error", "message"),
    [
        (
            lambda *a, **k: torch.zeros(4, 5, 3),
            UsageError,
            r"plans of shape \(count, K\+1, n\) = \(4, 6, 3\)",
        ),
        (lambda *a, **k: torch.zeros(6, 3), UsageError, r"found \(6, 3\)"),
        (lambda *a, **k: None, UsageError, "planner 'waltz': "),
        (lambda *a, **k: "plan", UsageError, "planner 'waltz': "),
        (changed((2, 3, 1), float("nan")), NonFiniteError, "plan 2 has nan for py at step 3"),
        (changed((0, 5, 2), float("inf")), NonFiniteError, "plan 0 has inf for theta at step 5"),
        (changed((1, 0, 0), 1.1), UsageError, "plan 1 begins with px = 1.1, the start has 1; row 0 of a plan is the"),
        (fails, UsageError, "planner 'waltz': ZeroDivisionError: nothing left"),
        (wrong_words, UsageError, "planner 'waltz': TypeError: .*unexpected keyword argument"),
    ],
)
def test_what_is_no_plan_is_one_line(planner, error, message):
    with pytest.raises(error, match=message) as caught:
        sample(planner)
    assert "\n" not in str(caught.value)


def test_what_cannot_be_called_is_no_planner():
    with pytest.raises(UsageError, match="'waltz' is neither a function nor an object with a method 'sample'"):
        sample(3)
