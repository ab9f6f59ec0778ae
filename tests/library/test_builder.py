import dataclasses

import pytest
import torch

from sagemp_cli.errors import ConfigError
from sagemp_cli.library import REASONS, Fill, build_library
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
        "duplicate of an entry": 0,
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


def beside(height, tag):
    """A plan that passes the disc at (2, 2) below (the goal is below too) or, over its top, above."""
    path = plan(GOOD, tag)
    path[1:-1, 1] = height
    return path


BELOW, ABOVE = [beside(0.1 * i, i) for i in range(8)], [beside(3.0 + 0.1 * i, -1 - i) for i in range(8)]


def filled(plans, outcomes=None, *, wanted, batch=4, **options):
    """A library of these plans, and the numbers of its entries."""
    source = Source([GOOD])
    source.plans = torch.stack(plans)
    arguments = {"scene": SCENE, "position": POSITION, "budget": len(plans), "batch": batch}
    made = build_library(source, verifier(outcomes or {}), wanted=wanted, **arguments, **options)
    return made, tags(made.certified.references)


def test_an_entry_that_repeats_another_is_not_taken():
    plans = [beside(0.1, 0), beside(0.1005, 1), beside(0.3, 2), beside(0.1005, 3)]
    made, found = filled(plans, wanted=4, batch=3, apart=0.01)
    assert found == [0, 2]
    assert tags(made.rejected) == [1, 3] and set(made.reasons) == {"duplicate of an entry"}
    assert filled(plans, wanted=4)[1] == [0, 1, 2, 3]


def test_references_that_agree_at_some_steps_only_do_not_repeat_each_other():
    assert filled([beside(0.1, 0), beside(0.2, 1)], wanted=2, apart=0.05)[1] == [0, 1]


def test_the_modes_of_entries_and_of_proposals_are_counted():
    made, found = filled([*BELOW[:4], ABOVE[0]], {-1: Outcome.MAY_COLLIDE}, wanted=3)
    assert found == [0, 1, 2] and made.modes == ("R", "R", "R")
    assert (made.coverage.names, made.coverage.drawn, made.coverage.held) == (("R",), (4,), (3,))
    made, _ = filled([*BELOW[:4], ABOVE[0], BELOW[5]], {-1: Outcome.MAY_COLLIDE}, wanted=5)
    assert made.coverage.missing == ("L",)
    assert made.coverage.lines()[0] == "modes: R 5 (planner 83%), L 0 (planner 17%)"
    assert "holds none of L" in made.coverage.lines()[1]


def test_filled_by_modes_each_has_its_even_share():
    plans = [*BELOW[:6], *ABOVE[:2], *BELOW[6:], *ABOVE[2:]]
    assert filled(plans, wanted=4)[1] == [0, 1, 2, 3]
    made, found = filled(plans, wanted=6, fill=Fill.MODES)
    assert sorted(made.modes) == ["L"] * 2 + ["R"] * 4  # before the second mode was seen the first had filled up
    made, found = filled([BELOW[0], ABOVE[0], *BELOW[1:], *ABOVE[1:]], wanted=6, fill=Fill.MODES)
    assert sorted(made.modes) == ["L"] * 3 + ["R"] * 3 and made.coverage.missing == ()


def test_what_was_set_aside_fills_the_library_when_the_budget_is_over():
    made, found = filled([BELOW[0], ABOVE[0], *BELOW[1:]], wanted=6, fill=Fill.MODES)
    assert len(found) == 6 and made.modes.count("L") == 1


def test_a_mode_that_never_certifies_takes_nobodys_place():
    outcomes = {-1 - i: Outcome.MAY_COLLIDE for i in range(8)}
    made, found = filled([BELOW[0], ABOVE[0], *BELOW[1:], ABOVE[1]], outcomes, wanted=6, fill=Fill.MODES)
    assert len(found) == 6 and set(made.modes) == {"R"} and made.coverage.missing == ("L",)
