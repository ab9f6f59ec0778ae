"""Verdicts about loops of strangers: certified, refuted, unknown; with and without scene and goal."""

from __future__ import annotations

import math

import pytest
import torch

from sagemp_cli.errors import UsageError
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.interval.interval import Interval
from sagemp_cli.reachability.observed import observed
from sagemp_cli.scenes.scene import scene_from_mapping
from sagemp_cli.sets import Box
from sagemp_cli.verification.strangers_loop import LoopClaim, verify_loop
from sagemp_cli.verification.verdict import Answer, Outcome

INF = math.inf
START = Box(torch.tensor([0.9, -0.1]), torch.tensor([1.1, 0.1]))
W = Box(torch.tensor([-0.01]), torch.tensor([0.01]))


def spiral(x, w):
    """A slowly turning, contracting map, pushed along its first state."""
    turn = torch.tensor([[0.85, -0.35], [0.35, 0.85]], dtype=torch.float64)
    return x @ turn.T + w * torch.tensor([1.0, 0.0], dtype=torch.float64)


def claim_of(*, workspace=None, obstacles=(), goal=None, position=(0, 1)):
    everywhere = {"lower": [-INF] * len(position), "upper": [INF] * len(position)}
    data = {
        "workspace": everywhere if workspace is None else dict(zip(("lower", "upper"), workspace, strict=True)),
        "obstacles": list(obstacles),
        "goal": dict(zip(("lower", "upper"), goal or ([-INF] * 2, [INF] * 2), strict=True)),
    }
    return LoopClaim(scene_from_mapping(data, state_dim=2, position_dim=len(position)), position, ("a", "b"))


def proved(claim, *, step=spiral, counts=(1, 1), horizon=12, propagator=None, **options):
    seen = observed(step, START, W, horizon)
    generator = torch.Generator().manual_seed(0)
    return verify_loop(seen, propagator or Affine(), claim, counts=counts, generator=generator, **options)


def test_a_claim_that_holds_is_certified_with_its_clearance():
    ball = {"kind": "ball", "name": "middle", "center": [0.3, -0.9], "radius": 0.3}
    proof = proved(claim_of(workspace=([-2.0, -2.0], [2.0, 2.0]), obstacles=[ball], goal=([-0.6, -0.6], [0.6, 0.6])))
    assert proof.answer is Answer.VERIFIED and proof.counterexample is None
    assert proof.verification.constraint_names == ("workspace", "middle")
    generator = torch.Generator().manual_seed(0)
    x, w = START.sample(500, generator), W.sample(500 * 12, generator).unflatten(0, (500, 12))
    nearest = torch.full((500,), INF).double()
    for k in range(13):
        nearest = torch.minimum(nearest, (x - torch.tensor([0.3, -0.9])).norm(dim=-1) - 0.3)
        assert bool((x >= proof.tube.lower[k]).all() and (x <= proof.tube.upper[k]).all())
        x = spiral(x, w[:, k]) if k < 12 else x
    assert 0 < float(proof.verification.clearance[0, 1]) <= float(nearest.min())


@pytest.mark.parametrize(
    ("claim", "what"),
    [
        ({"goal": ([-0.01, -INF], [0.01, INF])}, "goal a"),
        ({"obstacles": [{"kind": "ball", "name": "wall", "center": [0.35, 0.85], "radius": 0.2}]}, "wall"),
        ({"workspace": ([-2.0, -0.5], [2.0, 0.5])}, "workspace"),
    ],
)
def test_a_claim_that_is_broken_is_refuted_by_a_rollout_that_breaks_it(claim, what):
    proof = proved(claim_of(**claim))
    assert proof.answer is Answer.FALSIFIED
    verdict, example = proof.verification.verdicts[0], proof.counterexample
    assert verdict.outcome is Outcome.UNSAFE and verdict.constraint == what and example.proved
    x = example.start
    assert bool(START.contains(x)) and bool(W.contains(example.disturbances).all())
    for k in range(verdict.step):
        x = spiral(x, example.disturbances[k])
    torch.testing.assert_close(x, example.states[verdict.step], rtol=0, atol=1e-12)


def test_what_intervals_cannot_prove_and_nothing_refutes_is_unknown():
    goal = {"goal": ([-0.5, -0.5], [0.5, 0.5])}
    assert proved(claim_of(**goal)).answer is Answer.VERIFIED
    assert proved(claim_of(**goal), propagator=Interval()).answer is Answer.UNKNOWN


def test_without_scene_and_goal_a_tube_that_stays_bounded_is_proved_and_one_that_does_not_is_unknown():
    proof = proved(claim_of(position=(0,)))
    assert proof.answer is Answer.VERIFIED and proof.rollouts == 0
    assert proof.verification.constraint_names == () and proof.verification.clearance.shape == (1, 0)

    def explode(x, w):
        return x * x * 30.0 + w

    assert proved(claim_of(position=(0,)), step=explode, horizon=40).answer is Answer.UNKNOWN


def test_an_adaptive_partition_splits_until_it_is_proved_and_covers_the_start():
    def folding(x, w):
        return torch.stack([torch.relu(x[..., 0] - 1.0) * (x[..., 0] - 1.0), 0.5 * x[..., 1]], -1) + 0 * w

    goal = {"goal": ([-0.001, -INF], [0.0105, INF])}
    one = proved(claim_of(**goal), step=folding, horizon=1)
    auto = proved(claim_of(**goal), step=folding, horizon=1, counts=None)
    assert one.answer is Answer.UNKNOWN and auto.answer is Answer.VERIFIED
    cells = auto.verification.cells
    assert len(cells.lower) > 1
    points = START.sample(2000, torch.Generator().manual_seed(0))
    inside = (points[:, None] >= cells.lower).all(-1) & (points[:, None] <= cells.upper).all(-1)
    assert bool(inside.any(1).all())


def test_a_claim_that_a_rollout_from_the_centre_breaks_is_split_no_further():
    proof = proved(claim_of(workspace=([-2.0, -0.5], [2.0, 0.5])), counts=None)
    assert proof.answer is Answer.FALSIFIED and len(proof.verification.cells.lower) == 1


def test_steps_that_differ_are_bounded_each_by_its_own_program():
    def varying(k, x, w):
        return spiral(x, w) + (0.5 if k == 3 else 0.0)

    proof = proved(claim_of(position=(0,)), step=varying, horizon=6)
    assert proof.answer is Answer.VERIFIED and len(proof.loop.programs) == 6
    x = START.center
    for k in range(6):
        x = varying(k, x, torch.zeros(1).double())
    assert bool((x > proof.tube.lower[6]).all() and (x < proof.tube.upper[6]).all())


def test_a_claim_about_other_states_is_refused():
    seen = observed(lambda x, w: 0.5 * x + w, Box(torch.zeros(3), torch.ones(3)), W, 2)
    with pytest.raises(UsageError, match="the loop has 3 states, the claim speaks of 2"):
        verify_loop(seen, Affine(), claim_of(), counts=[1, 1, 1], generator=torch.Generator())
