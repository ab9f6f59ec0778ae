"""Decisions by the largest score: what torch's argmax picks, bounded, certified and checked."""

import importlib.util
from pathlib import Path

import pytest
import torch

from sagemp_cli.checker.check import check
from sagemp_cli.errors import UnsupportedOperationError, UsageError
from sagemp_cli.reachability import reach
from sagemp_cli.reachability.decisions import choose
from sagemp_cli.sets import Box
from sagemp_cli.stages.prove import prove


def example():
    path = Path(__file__).parents[2] / "examples" / "advisory" / "advisory.py"
    spec = importlib.util.spec_from_file_location("advisory", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_it_is_what_argmax_picks_the_first_of_equal_ones():
    g = torch.Generator().manual_seed(0)
    scores = torch.randint(0, 4, (500, 5), generator=g).double()
    values = torch.randn(500, 5, 3, generator=g)
    first = (scores == scores.amax(-1, keepdim=True)).double().cumsum(-1).eq(1).double().argmax(-1)
    assert torch.equal(choose(scores, values), values[torch.arange(500), first])


def switched(x, w):
    scores = torch.stack([x[..., 0], 0.5 - x[..., 1], x[..., 1] * x[..., 0]], -1)
    values = torch.tensor([[1.0, -1.0], [0.0, 2.0], [-2.0, 0.5]], dtype=torch.float64)
    return 0.5 * x + 0.1 * choose(scores, values) + w


@pytest.mark.parametrize("propagator", ["affine", "crown", "best", "interval"])
def test_every_decision_that_is_possible_is_in_the_tube(propagator):
    start, w = Box.around([0.3, 0.2], [0.4, 0.4]), Box.around([0.0, 0.0], [0.05, 0.05])
    tube = reach(switched, start, w, horizon=6, propagator=propagator)
    g = torch.Generator().manual_seed(0)
    x = start.sample(2000, g)
    for k in range(6):
        x = switched(x, w.sample(2000, g))
        assert bool(((x >= tube.lower[k + 1]) & (x <= tube.upper[k + 1])).all())


def test_one_possible_decision_is_that_value():
    tube = reach(lambda x: choose(torch.stack([x[..., 0], 1 - x[..., 0]], -1), torch.eye(2).double()[:, :1]),
                 Box.around([0.8], [0.2]), horizon=1)  # fmt: skip
    assert 1.0 - 1e-12 < tube.lower[1, 0] <= 1.0 <= tube.upper[1, 0] < 1.0 + 1e-12


def test_argmax_itself_is_refused_with_the_way_out():
    with pytest.raises(UnsupportedOperationError, match="sagemp_cli.reachability.decisions.choose"):
        reach(lambda x: x * torch.argmax(x, -1), Box.around([0.8, 0.1], [0.2, 0.1]), horizon=1)


def test_as_many_values_as_scores_are_needed():
    with pytest.raises(UsageError, match=r"choose: .* found \(2,\) and \(3, 1\)"):
        choose(torch.zeros(2), torch.zeros(3, 1))


def test_the_advisories_of_the_example_are_certified_and_checked(tmp_path):
    module = example()
    start, w = Box.around([100.0, 0.0], [50.0, 5.0]), Box.around([0.0], [1.0])
    goal = Box(torch.tensor([300.0, -10.0]).double(), torch.tensor([900.0, 50.0]).double())
    found = prove(
        module.step, start, w, 20, goal=goal, partitions="auto", restarts=1, dt=1.0, certificate=tmp_path / "a.h5"
    )
    assert found.answer == "VERIFIED"
    assert check(tmp_path / "a.h5").answer == "VERIFIED"
