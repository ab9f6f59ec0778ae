import dataclasses

import pytest
import torch

from sagemp_cli.dynamics import Dynamics
from sagemp_cli.errors import UsageError
from sagemp_cli.execution import execute_queries, inside_tube, random_disturbances, worst_case_disturbances
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.loop.tracker import Tracker
from sagemp_cli.problem import Problem
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.scenes import Ball, Scene
from sagemp_cli.sets import Box, Tube
from sagemp_cli.verification.attack.refutation import FalsifierOptions, SoundnessError, attack
from sagemp_cli.verification.cells import CellProver
from sagemp_cli.verification.verdict import Outcome, Verdict
from sagemp_cli.verification.verification import verify_references

K = 20


class Cart(Dynamics):
    """Two positions that are steered directly: with a linear tracker the loop is affine and tubes are exact."""

    state_names = ("px", "py")
    state_units = ("m", "m")
    control_names = ("vx", "vy")
    control_units = ("m/s", "m/s")
    position = (0, 1)

    def derivative(self, x, u):
        return u


@pytest.fixture
def cart():
    limits = {"control_lower": [-5.0] * 2, "control_upper": [5.0] * 2}
    return Cart(dt=0.1, state_lower=[-9.0] * 2, state_upper=[9.0] * 2, **limits)


@pytest.fixture
def tracker():
    """``u = 4 e`` for the next reference, through the linear parts of two leaky ReLUs: relu(e) - relu(-e)."""
    found = Tracker(state_dim=2, control_dim=2, lookahead=1, hidden=[4], negative_slope=0.0)
    with torch.no_grad():
        eye = torch.eye(2, dtype=torch.float64)
        found.layers[0].weight.copy_(torch.cat([eye, -eye]))
        found.layers[0].bias.zero_()
        found.layers[1].weight.copy_(4 * torch.cat([eye, -eye], dim=1))
        found.layers[1].bias.zero_()
    return found


SCENE = Scene(Box([-3.0, -3.0], [5.0, 3.0]), (Ball((1.0, 1.2), 0.3, "disc"),), Box([1.5, -0.5], [2.5, 0.5]))
START, W = Box.around([0.0, 0.0], [0.3, 0.3]), Box.around([0.0, 0.0], [0.2, 0.2])


def plans(*heights):
    x = torch.linspace(0, 2, K + 1, dtype=torch.float64)
    return torch.stack([torch.stack([x, h * torch.sin(1.5 * x)], -1) for h in heights])


def problem(cart, **changes):
    return dataclasses.replace(Problem(cart, SCENE, START, W, K), **changes)


@pytest.fixture
def library(cart, tracker):
    found = verify_references(CellProver(Affine(), problem(cart), tracker), plans(0.0, -0.6), counts=[2, 2])
    assert [v.outcome for v in found.verdicts] == [Outcome.SAFE, Outcome.SAFE]
    return found


def run(library, cart, tracker, *, starts, propose, rollouts=40):
    return execute_queries(
        library,
        propose,
        problem=problem(cart),
        tracker=tracker,
        starts=starts,
        rollouts=rollouts,
        generator=torch.Generator().manual_seed(1),
    )


def test_every_rollout_stays_in_its_tube_and_the_closest_reference_is_tracked(library, cart, tracker):
    starts = START.sample(6, torch.Generator().manual_seed(0))
    starts[0], starts[1] = START.lower, START.center  # a corner, and the common corner of all cells
    proposals = plans(-0.5, 0.1, -0.4, 0.0, -0.7, -0.1)
    done = run(library, cart, tracker, starts=starts, propose=lambda s: proposals)
    assert done.chosen.tolist() == [1, 0, 1, 0, 1, 0]
    assert done.states.shape == (240, K + 1, 2)
    assert bool(done.in_tube.all()) and bool(done.safe.all())
    assert torch.equal(done.states[:, 0], starts[done.query])
    loop = ClosedLoop(cart, tracker, library.references[done.chosen[done.query]])
    states, controls = loop.rollout(done.states[:, 0], done.disturbances)
    assert torch.equal(states, done.states) and torch.equal(controls, done.controls)
    assert bool(W.contains(done.disturbances).all())


def test_a_start_outside_every_certified_box_is_refused(library, cart, tracker):
    starts = torch.tensor([[0.0, 0.0], [0.31, 0.0]], dtype=torch.float64)
    with pytest.raises(
        UsageError, match=r"measured start \[0.31, 0.0\] lies in the start box X_I of none of 2 certified"
    ):
        run(library, cart, tracker, starts=starts, propose=lambda s: plans(0.0, 0.0))


def test_only_references_whose_start_box_contains_the_start_are_eligible(library, cart, tracker):
    shift = torch.tensor([[0.0, 0.0], [0.0, -0.4]])
    starts = Box(START.lower + shift, START.upper + shift)
    moved = verify_references(
        CellProver(Affine(), problem(cart, start=starts), tracker), plans(0.0, -0.6), counts=[2, 2]
    )
    starts = torch.tensor([[0.0, 0.2], [0.0, -0.2]], dtype=torch.float64)
    done = run(moved, cart, tracker, starts=starts, propose=lambda s: plans(-0.6, -0.6), rollouts=2)
    assert done.chosen.tolist() == [0, 1]


def test_worst_case_disturbances_reach_the_exact_tube_of_an_affine_loop(library, cart, tracker):
    count = 400
    loop = ClosedLoop(cart, tracker, library.references[0])
    generator = torch.Generator().manual_seed(2)
    x = START.lower.expand(count, 2)
    w = worst_case_disturbances(loop, x, disturbance=W, generator=generator)
    assert bool(((w == W.lower) | (w == W.upper)).all())
    states, _ = loop.rollout(x, w)
    tame, _ = loop.rollout(x, random_disturbances(W, count, horizon=K, generator=generator))
    # From the lower corner: the deviation contracts by 0.6 a step and w adds 0.02, so |.| ends at 0.05 either way.
    spread = (states[:, -1].amax(0) - states[:, -1].amin(0)).detach()
    assert spread.tolist() == pytest.approx([0.1, 0.1], rel=1e-2)
    assert bool((tame[:, -1].amax(0) - tame[:, -1].amin(0) < 0.09).all())


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_rollout_a_micrometre_outside_of_its_tube_is_not_inside(side):
    """The tolerance is for rounding, in units of a nanometre, and for nothing else."""
    cells, tubes = Box([[0.0]], [[1.0]]), Tube(torch.zeros(1, 2, 1).double(), torch.ones(1, 2, 1).double())
    face = torch.tensor([0.5 + 0.5 * side], dtype=torch.float64)
    off = torch.tensor([0.0, 1e-10, 1e-8, 1e-6], dtype=torch.float64)[:, None]
    states = torch.stack([torch.full_like(off, 0.5), face + side * off], 1)
    assert inside_tube(states, cells, tubes).tolist() == [True, True, False, False]


def test_a_rollout_that_leaves_one_of_its_cells_is_not_inside():
    cells = Box([[0.0], [1.0]], [[1.0], [2.0]])
    tubes = Tube(
        torch.tensor([[[0.0], [0.0]], [[1.0], [5.0]]]).double(), torch.tensor([[[1.0], [1.0]], [[2.0], [6.0]]]).double()
    )
    states = torch.tensor([[[0.5], [0.5]], [[0.5], [5.5]], [[1.5], [5.5]], [[1.0], [0.5]], [[3.0], [5.5]]]).double()
    # In the first cell; out of it; in the second; on the common face but in one tube only; in no cell at all.
    assert inside_tube(states, cells, tubes).tolist() == [True, False, True, False, False]


def test_an_attack_refutes_what_is_unsafe_and_certified_references_withstand(library, cart, tracker):
    crash = verify_references(CellProver(Affine(), problem(cart), tracker), plans(0.0, 0.9), counts=[1, 1])
    assert [str(v.outcome) for v in crash.verdicts] == ["SAFE", "MAY_COLLIDE"]
    options, generator = FalsifierOptions(restarts=4), torch.Generator().manual_seed(0)
    found = attack(crash, problem(cart), tracker=tracker, generator=generator, options=options)
    assert [str(v.outcome) for v in found.verification.verdicts] == ["SAFE", "UNSAFE"]
    ((index, example),) = found.counterexamples
    assert (index, example.kind, example.name) == (1, "obstacle", "disc")
    assert found.verification.verdicts[1] == Verdict(Outcome.UNSAFE, example.step, "disc", example.fraction)
    assert found.rollouts > 0


def test_a_certified_reference_that_is_refuted_is_an_internal_error(library, cart, tracker):
    narrow = Scene(SCENE.workspace, SCENE.obstacles, Box([1.9, -0.01], [2.0, 0.01]))
    with pytest.raises(
        SoundnessError, match="certified by 'affine', but a replayed rollout breaks 'goal px' at step 20"
    ):
        attack(library, problem(cart, scene=narrow), tracker=tracker, generator=torch.Generator().manual_seed(0))
