import dataclasses

import pytest
import torch

from sagemp_cli.errors import ConfigError
from sagemp_cli.library import REASONS, build_library
from sagemp_cli.library.builder import NothingCertifiedError, reference_faults
from sagemp_cli.scenes import Ball, Scene
from sagemp_cli.sets import Box, Tube
from sagemp_cli.verification.verdict import Outcome, Verdict
from sagemp_cli.verification.verification import Verification

K, POSITION = 4, (0, 1)
SCENE = Scene(Box([-5.0, -5.0], [5.0, 5.0]), (Ball((2.0, 2.0), 0.5, "disc"),), Box([3.0, -1.0, -9.0], [5.0, 1.0, 9.0]))
GOOD, CRASH, SHORT, OUTSIDE = "good", "crash", "short", "outside"


def plan(kind, tag):
    """A straight plan into the goal that carries a number in its third state, or one with a fault."""
    path = torch.zeros(K + 1, 3, dtype=torch.float64)
    path[:, 0] = torch.linspace(0, 4, K + 1)
    path[:, 2] = tag
    if kind == CRASH:
        path[2, 1] = 2.0
    if kind == SHORT:
        path[:, 0] *= 0.5
    if kind == OUTSIDE:
        path[1, 1] = 6.0
    return path


class Source:
    """A planner that gives a fixed list of plans."""

    def __init__(self, kinds):
        self.plans, self.given = torch.stack([plan(kind, i) for i, kind in enumerate(kinds)]), 0

    def __call__(self, count):
        some = self.plans[self.given : self.given + count]
        self.given += count
        return some


def verifier(outcomes, asked=None):
    """Proves what a table says about each plan's number; tubes are the plans themselves."""

    def verify(references):
        tags = [int(t) for t in references[:, 0, 2]]
        if asked is not None:
            asked.extend(tags)
        count = len(tags)
        box = Box(references[:, 0], references[:, 0])
        return Verification(
            references=references,
            start=box,
            disturbance=Box([0.0] * 3, [0.0] * 3),
            cell_reference=torch.arange(count),
            cells=box,
            tube=Tube(references, references),
            control_lower=torch.zeros(count, K, 1),
            control_upper=torch.zeros(count, K, 1),
            verdicts=tuple(Verdict(outcomes.get(t, Outcome.SAFE)) for t in tags),
            constraint_names=SCENE.constraint_names,
            clearance=torch.ones(count, 2),
            goal_margin=torch.ones(count, 3),
            seconds=torch.ones(count),
            propagator="table",
            rigorous=True,
        )

    return verify


def build(kinds, outcomes=None, *, wanted, budget=None, batch=3, asked=None):
    return build_library(
        Source(kinds),
        verifier(outcomes or {}, asked),
        scene=SCENE,
        position=POSITION,
        wanted=wanted,
        budget=budget or len(kinds),
        batch=batch,
    )


def tags(references):
    return references[:, 0, 2].int().tolist()


def test_every_reason_is_counted_and_named():
    kinds = [GOOD, CRASH, SHORT, OUTSIDE, GOOD, GOOD, GOOD]
    outcomes = {4: Outcome.MAY_COLLIDE, 5: Outcome.MISSES_GOAL, 6: Outcome.UNBOUNDED}
    made = build(kinds, outcomes, wanted=5)
    assert tags(made.certified.references) == [0]
    assert tags(made.rejected) == [1, 2, 3, 4, 5, 6]
    assert made.reasons == (
        "reference in collision",
        "reference misses goal",
        "reference in collision",
        "tube in collision",
        "tube misses goal",
        "tube unbounded",
    )
    assert dict(zip(REASONS, made.counts, strict=True)) == {
        "reference in collision": 2,
        "reference misses goal": 1,
        "tube in collision": 1,
        "tube misses goal": 1,
        "tube unbounded": 1,
    }
    assert made.sampled == 7


def test_a_reference_that_is_out_by_itself_is_never_propagated():
    asked = []
    build([CRASH, GOOD, SHORT, GOOD], wanted=2, asked=asked)
    assert asked == [1, 3]


def test_sampling_stops_when_enough_are_certified():
    made = build([GOOD] * 30, wanted=4, batch=3)
    assert tags(made.certified.references) == [0, 1, 2, 3]
    assert made.sampled == 6
    assert len(made.rejected) == 0


def test_sampling_stops_at_the_budget_exactly():
    made = build([GOOD, CRASH] * 10, wanted=6, budget=7, batch=3)
    assert made.sampled == 7
    assert tags(made.certified.references) == [0, 2, 4, 6]


def test_a_library_of_several_batches_keeps_each_reference_with_its_tube():
    made = build([GOOD, CRASH, GOOD, GOOD, SHORT, GOOD], wanted=4, batch=2).certified
    assert torch.equal(made.tube.lower, made.references)
    assert torch.equal(made.start.lower, made.references[:, 0])
    assert len(made.verdicts) == 4


def test_nothing_certified_is_an_error_with_the_account():
    with pytest.raises(NothingCertifiedError) as caught:
        build([CRASH, CRASH, SHORT], wanted=1)
    assert str(caught.value) == (
        "library: none of 3 sampled references could be certified "
        "(2 x reference in collision, 1 x reference misses goal)"
    )
    assert caught.value.exit_code == 5


def test_a_budget_below_the_size_is_refused():
    with pytest.raises(ConfigError, match="budget at least size, found size 5, batch 3, budget 4"):
        build([GOOD] * 9, wanted=5, budget=4)


def test_touching_an_obstacle_is_a_collision_of_the_reference_too():
    touching = plan(GOOD, 0)
    touching[1, :2] = torch.tensor([1.5, 2.0])
    assert reference_faults(torch.stack([touching, plan(GOOD, 1)]), SCENE, position=POSITION) == [
        "reference in collision",
        "",
    ]


def test_selecting_and_joining_verifications_is_lossless():
    verification = verifier({1: Outcome.MISSES_GOAL})(Source([GOOD] * 4)(4))
    again = Verification.join([verification.select([0, 1]), verification.select([2, 3])])
    for field in dataclasses.fields(Verification):
        a, b = getattr(verification, field.name), getattr(again, field.name)
        if isinstance(a, torch.Tensor):
            assert torch.equal(a, b), field.name
        elif isinstance(a, Box | Tube):
            assert torch.equal(a.lower, b.lower) and torch.equal(a.upper, b.upper), field.name
        else:
            assert a == b, field.name
    assert verification.safe == [0, 2, 3]
