"""What halving a cell does to its tube is foreseen nearly as it comes out."""

import pytest
import torch

from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.crown.crown import Crown
from sagemp_cli.reachability.foreseeing import reach_foreseeing
from sagemp_cli.reachability.observed import observed
from sagemp_cli.sets import Box
from sagemp_cli.sets.partition import halved

START, W = Box.around([0.3, 0.0, 0.4], [0.2, 0.3, 0.1]), Box.around([0.0], [0.02])
K = 12


@pytest.fixture(scope="module")
def seen():
    with torch.random.fork_rng():
        torch.manual_seed(3)
        network = torch.nn.Sequential(torch.nn.Linear(3, 40), torch.nn.ReLU(), torch.nn.Linear(40, 1)).double()

    def step(x, w):
        u = torch.tanh(network(x))[..., 0]
        a, b, c = x.unbind(-1)
        return torch.stack([a + 0.1 * b, 0.9 * b - 0.1 * torch.sin(a) - 0.1 * u + w[..., 0], 0.9 * c + 0.2 * a * b], -1)

    return observed(step, START, W, K)


def real_and_foreseen(seen, cells, propagator=None):
    """Mean widths of both halves in each state, as they are and as they were foreseen, ``(n,)`` each."""
    found = reach_foreseeing(propagator or Affine(), seen.loop, cells, W)
    real, foreseen = [], []
    for i in range(3):
        halves = halved(cells, torch.full((len(cells.lower),), i))
        real.append((propagator or Affine()).reach(seen.loop, halves, W).tube.width.mean())
        foreseen.append(found.halves.tubes(found.tube, i).width.mean())
    return torch.stack(real), torch.stack(foreseen), found.tube.width.mean()


def test_the_widths_of_halves_are_foreseen_within_a_tenth_of_what_halving_gains(seen):
    whole = Box(START.lower[None], START.upper[None])
    for cells in (whole, halved(whole, torch.tensor([0])), halved(whole, torch.tensor([2]))):
        real, foreseen, one = real_and_foreseen(seen, cells)
        assert bool(((foreseen - real).abs() <= 0.1 * (one - real)).all()), (real, foreseen, one)
        assert int(real.argmin()) == int(foreseen.argmin())


def test_foreseen_tubes_begin_with_the_halves_themselves(seen):
    whole = Box(START.lower[None], START.upper[None])
    found = reach_foreseeing(Affine(), seen.loop, whole, W)
    for i in range(3):
        halves, tubes = halved(whole, torch.tensor([i])), found.halves.tubes(found.tube, i)
        assert torch.allclose(tubes.lower[0, :, 0], halves.lower) and torch.allclose(tubes.upper[0, :, 0], halves.upper)


def test_a_tube_is_the_same_whether_halves_are_foreseen_or_not(seen):
    cells = Box(START.lower[None], START.upper[None])
    one, other = Affine().reach(seen.loop, cells, W), reach_foreseeing(Affine(), seen.loop, cells, W)
    assert torch.equal(one.tube.lower, other.tube.lower) and torch.equal(one.tube.upper, other.tube.upper)
    assert one.halves is None


def test_other_propagators_are_guided_by_forms_and_keep_their_tubes(seen):
    cells = Box(START.lower[None], START.upper[None])
    found = reach_foreseeing(Crown(), seen.loop, cells, W)
    assert torch.equal(found.tube.lower, Crown().reach(seen.loop, cells, W).tube.lower)
    assert found.halves is not None and bool((found.halves.narrowing > 0).any())
