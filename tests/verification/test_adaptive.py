import dataclasses

import pytest
import torch

from sagemp_cli.checker.cover import covered
from sagemp_cli.dynamics import Unicycle
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.loop.tracker import Tracker
from sagemp_cli.problem import Problem
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.halves import Halves
from sagemp_cli.scenes import Ball, Scene
from sagemp_cli.sets import Box, Tube
from sagemp_cli.verification.adaptive import adaptive_cells
from sagemp_cli.verification.cells import CellProver, CellTubes
from sagemp_cli.verification.cutting import best_cut
from sagemp_cli.verification.verdict import Outcome
from sagemp_cli.verification.verification import verify_references


class Stretched:
    """Tubes whose width is that of the cell times a factor per dimension; SAFE if narrow enough."""

    def __init__(self, factors, limit=1.0, floor=0.0):
        self.factors, self.limit, self.floor = torch.tensor(factors, dtype=torch.float64), limit, floor
        self.calls = []

    def prove(self, owner, cells):
        self.calls.append(len(owner))
        reach = (cells.width * self.factors).amax(-1, keepdim=True).clamp(min=self.floor).expand(cells.width.shape)
        tube = Tube(torch.stack([cells.lower, -reach], 1), torch.stack([cells.upper, reach], 1))
        none = torch.zeros(len(owner), 1, 1, dtype=torch.float64)
        cut = (cells.width * self.factors).argmax(-1)
        cut = torch.where((cells.center == cells.lower).all(-1), -1, cut)
        return CellTubes(owner, cells, tube, none, none, none[:, 0, 0], None, cut=cut)

    def shortfall(self, found):
        tube = found.tube
        missing = (tube.upper[:, 1, 0] - self.limit).clamp(min=0.0)
        return missing == 0, missing


def never(owner, cells):
    return torch.zeros(len(owner), dtype=torch.bool)


def split(model, start, *, budget=64, hopeless=never):
    return adaptive_cells(model.prove, start, budget=budget, shortfall=model.shortfall, hopeless=hopeless)


def boxes(*widths):
    upper = torch.tensor(widths, dtype=torch.float64)
    return Box(torch.zeros_like(upper), upper)


def test_a_start_box_that_is_proved_in_one_piece_is_left_in_one_piece():
    model = Stretched([1.0, 1.0])
    found = split(model, boxes([1.0, 1.0], [0.5, 0.9]))
    assert found.cell_reference.tolist() == [0, 1] and model.calls == [2]


def test_only_the_dimension_that_helps_is_split():
    found = split(Stretched([8.0, 0.1, 1.0]), boxes([1.0, 1.0, 0.0]))
    assert len(found) == 8
    assert found.cells.width.tolist() == [[0.125, 1.0, 0.0]] * 8


def test_references_get_the_cells_they_need_and_no_more_than_the_budget():
    start = boxes([1.0, 1.0], [4.0, 1.0], [64.0, 1.0])
    found = split(Stretched([1.0, 0.1]), start, budget=6)
    assert found.cell_reference.bincount().tolist() == [1, 4, 6]
    assert found.cell_reference.tolist() == sorted(found.cell_reference.tolist())


def test_all_halves_of_a_round_are_one_call_and_nothing_else_is_propagated():
    model = Stretched([4.0, 0.1])
    split(model, boxes([1.0, 1.0], [1.0, 1.0]))
    assert model.calls == [2, 2 * 2, 4 * 2]


@pytest.mark.parametrize("budget", [1, 2, 5, 13])
def test_the_cells_always_cover_the_start_box_exactly(budget):
    low = torch.tensor([[0.1, -1 / 3, 2.0]], dtype=torch.float64)
    start = Box(low, low + torch.tensor([[0.7, 1e-3, 0.0]], dtype=torch.float64))
    found = split(Stretched([70.0, 4e4, 1.0]), start, budget=budget)
    assert len(found) == budget
    args = (start.lower[0], start.upper[0], found.cells.lower, found.cells.upper)
    assert covered(*(a.numpy() for a in args))
    assert not covered(*(a.numpy() for a in (*args[:2], found.cells.lower[1:], found.cells.upper[1:])))


def test_a_reference_with_a_violating_rollout_is_split_no_further():
    asked = []

    def second(owner, cells):
        asked.append((owner.tolist(), cells.upper.tolist()))
        return owner == 1

    found = split(Stretched([4.0, 0.1]), boxes([1.0, 1.0], [1.0, 1.0]), hopeless=second)
    assert found.cell_reference.bincount().tolist() == [4, 1]
    assert asked == [([0, 1], [[1.0, 1.0], [1.0, 1.0]]), ([0, 0], [[0.5, 1.0], [1.0, 1.0]])]


def test_splitting_that_does_not_help_ends_before_the_budget():
    found = split(Stretched([1.0, 1.0], floor=2.0), boxes([1.0, 1.0]), budget=1000)
    assert len(found) == 8


def test_a_cell_is_cut_where_its_halves_are_foreseen_to_miss_least_and_then_to_be_narrowest():
    cells = boxes([1.0, 1.0, 1.0], [1.0, 1.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 0.0])
    zeros = torch.zeros(4, 3, 2, 3, dtype=torch.float64)
    tube = Tube(zeros[:, 0], zeros[:, 0] + 4.0)
    narrowing = zeros.clone()
    narrowing[:, 0, 1, 0], narrowing[:, 1, 1, 1], narrowing[:, 2, 1, 1] = 1.0, 0.5, 0.25
    halves = Halves(zeros, narrowing)

    def missing(found):  # of the cells only the first is asked for the first state
        second = found.width[:, 1, 1]
        return torch.where(torch.arange(8) < 2, found.width[:, 1, 0], second)

    assert best_cut(cells, tube, halves, missing).tolist() == [0, 1, 1, -1]
    assert best_cut(cells, tube, halves, lambda found: torch.zeros(8)).tolist() == [0, 0, 1, -1]


def test_a_box_with_no_number_inside_is_not_split():
    one = torch.ones(1, 1, dtype=torch.float64)
    start = Box(one, torch.nextafter(one, 2 * one))
    found = split(Stretched([1.0], floor=2.0), start)
    assert len(found) == 1


K = 8
ANYWHERE = Box([-9.0] * 4, [9.0] * 4)
SCENE = Scene(Box([-2.0, -3.0], [4.0, 3.0]), (Ball((0.4, 1.6), 0.2, "disc"),), ANYWHERE)


@pytest.fixture(scope="module")
def adaptive():
    limits = {"control_lower": [-1.5, -2.0], "control_upper": [1.5, 2.0]}
    unicycle = Unicycle(dt=0.1, state_lower=[-3.0, -4.0, -1.6, 0.0], state_upper=[9.0, 4.0, 1.6, 3.0], **limits)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        tracker = Tracker(state_dim=4, control_dim=2, lookahead=3, hidden=[8, 8])
    references = torch.zeros(3, K + 1, 4, dtype=torch.float64)
    references[..., 0] = 0.1 * torch.arange(K + 1)
    references[..., 3] = 1.0
    start = Box.around([0.0, 0.0, 0.0, 1.0], [0.3, 0.6, 0.0, 0.0])
    shift = torch.tensor([[0.0] * 4, [0.0, -0.5, 0.0, 0.0], [0.0, 1.5, 0.0, 0.0]])

    def verify(counts, scene=SCENE, **options):
        starts = Box(start.lower + shift, start.upper + shift)
        problem = Problem(unicycle, scene, starts, Box.around([0.0] * 4, [0.02, 0.02, 0.0, 0.02]), K)
        return verify_references(CellProver(Affine(), problem, tracker), references, counts=counts, **options)

    return unicycle, tracker, verify


def test_adaptive_cells_prove_what_one_cell_does_not(adaptive):
    _, _, verify = adaptive
    coarse, fine = (verify(c).cells_of(0)[1].hull().upper[-1, 2] for c in ([1, 1], [4, 4]))
    assert fine < coarse
    between = float(0.5 * fine + 0.5 * coarse)
    scene = dataclasses.replace(SCENE, goal=Box(ANYWHERE.lower, [9.0, 9.0, between, 9.0]))
    one, auto = verify([1, 1], scene), verify(None, scene, budget=32)
    assert str(one.verdicts[0]) == f"MISSES_GOAL at step {K} (goal theta)"
    assert auto.verdicts[0].outcome is Outcome.SAFE
    assert auto.verdicts[2].outcome is Outcome.MAY_COLLIDE
    per_reference = auto.cell_reference.bincount().tolist()
    assert 1 < per_reference[0] <= 32 and per_reference[2] == 1  # the third has a rollout that collides
    assert auto.recording.slope.shape[0] == sum(per_reference)
    assert bool((auto.seconds > 0).all())


def test_adaptive_tubes_enclose_the_rollouts_of_their_cells(adaptive):
    unicycle, tracker, verify = adaptive
    auto = verify(None, budget=16)
    generator = torch.Generator().manual_seed(0)
    for r in range(3):
        cells, tubes = auto.cells_of(r)
        loop = ClosedLoop(unicycle, tracker, auto.references[r])
        x = Box(auto.start.lower[r], auto.start.upper[r]).sample(300, generator)
        w = auto.disturbance
        states, _ = loop.rollout(x, torch.where(torch.rand(300, K, 4, generator=generator) < 0.5, w.lower, w.upper))
        member = cells.contains(x[:, None])
        assert bool(member.any(1).all())
        assert bool((tubes.contains(states[:, None]) | ~member).all())
