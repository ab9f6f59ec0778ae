import math

import pytest
import torch

from sagemp_cli.errors import UsageError
from sagemp_cli.scenes import Ball, Block, Scene
from sagemp_cli.sets import Between, Box, Bulge, Tube
from sagemp_cli.verification.verdict import Answer, Outcome, Verdict, answer_of, assess, shortfall

NAMES = ("px", "py", "theta")
SCENE = Scene(
    workspace=Box([-10.0, -10.0], [10.0, 10.0]),
    obstacles=(Ball((0.0, 5.0), 1.0, "disc"), Block((4.0, -6.0), (5.0, -4.0), "crate")),
    goal=Box([2.0, -1.0, -math.inf], [4.0, 1.0, math.inf]),
)


def tube(*boxes):
    """One reference, one cell: boxes are (px low, px high, py low, py high)."""
    lower = torch.tensor([[b[0], b[2], -0.1] for b in boxes], dtype=torch.float64)
    upper = torch.tensor([[b[1], b[3], 0.1] for b in boxes], dtype=torch.float64)
    return Tube(lower[None], upper[None])


def judge(t, *owner, **options):
    """Every cell belongs to the reference that is named, by default to one."""
    cells = torch.tensor(owner or [0] * len(t.lower))
    return assess(t, SCENE, cell_reference=cells, position=(0, 1), state_names=NAMES, **options)


def together(*tubes):
    return Tube(torch.cat([t.lower for t in tubes]), torch.cat([t.upper for t in tubes]))


CLEAR, GOAL = (-1.0, 1.0, -1.0, 1.0), (2.5, 3.5, -0.5, 0.5)


def test_a_clear_tube_that_ends_in_the_goal_is_safe():
    found = judge(tube(CLEAR, CLEAR, GOAL))
    assert found.verdicts == (Verdict(Outcome.SAFE, -1, ""),)
    assert found.clearance[0].tolist() == pytest.approx([6.5, 3.0, 3.0])
    assert found.goal_margin[0].tolist() == [0.5, 0.5, math.inf]


def test_a_tube_that_touches_an_obstacle_is_not_safe():
    touching = (-1.0, 1.0, 3.0, 4.0)
    assert judge(tube(CLEAR, touching, GOAL)).verdicts == (Verdict(Outcome.MAY_COLLIDE, 0, "disc", 7 / 8),)
    beside = (3.0, 4.0, -5.0, -4.5)
    assert judge(tube(CLEAR, beside, GOAL)).verdicts == (Verdict(Outcome.MAY_COLLIDE, 0, "crate", 7 / 8),)
    at_samples = judge(tube(CLEAR, touching, GOAL), between=Between.SAMPLES)
    assert at_samples.verdicts == (Verdict(Outcome.MAY_COLLIDE, 1, "disc"),)
    assert judge(tube(CLEAR, (-1.0, 1.0, 3.0, 4.0 - 1e-12), GOAL)).verdicts[0].outcome is Outcome.SAFE


def test_the_start_counts_and_the_earliest_step_is_named():
    found = judge(tube((9.5, 10.5, 0.0, 1.0), (-1.0, 1.0, 4.0, 6.0), GOAL))
    assert found.verdicts == (Verdict(Outcome.MAY_COLLIDE, 0, "workspace"),)
    assert str(found.verdicts[0]) == "MAY_COLLIDE at step 0 (workspace)"


def test_a_tube_that_passes_an_obstacle_between_two_samples_is_not_safe_and_the_time_is_named():
    low, high = (-0.1, 0.1, 1.0, 2.0), (-0.1, 0.1, 8.0, 9.0)  # the disc is from 4 to 6
    found = judge(tube(low, high, GOAL))
    assert found.verdicts == (Verdict(Outcome.MAY_COLLIDE, 0, "disc", 2 / 8),)  # 2 + 7 * 3/8 > 4
    assert str(found.verdicts[0]) == "MAY_COLLIDE at step 0.25 (disc)" and found.clearance[0, 1] <= 0
    assert judge(tube(low, high, GOAL), between=Between.SAMPLES).verdicts[0].outcome is Outcome.SAFE
    # From one side of the disc to the other, below it: nearer than at both samples.
    beside = judge(tube((-8.0, -7.0, 2.0, 2.0), (7.0, 8.0, 2.0, 2.0)), between=Between.SEGMENTS)
    assert 1.9 < float(beside.clearance[0, 1]) <= 2.0 < 6.0


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -1.0])
def test_a_bulge_counts_and_what_is_not_known_of_it_clears_nothing(wrong):
    t = tube(CLEAR, (2.5, 3.5, 2.0, 3.0), GOAL)
    none = torch.zeros(1, 2, 3, dtype=torch.float64)
    assert judge(t, lines=(t, Bulge(none, none, none))).verdicts[0].outcome is Outcome.SAFE
    bent = none.clone()
    bent[0, 1, 0] = 60.0
    swung = judge(t, lines=(t, Bulge(bent, bent, none)))
    assert swung.verdicts[0].outcome is Outcome.MAY_COLLIDE and swung.verdicts[0].step == 1
    assert judge(t, lines=(t, Bulge(none, none, bent))).verdicts[0].outcome is Outcome.MAY_COLLIDE
    bent[0, 1, 0] = wrong
    for parts in ((none, none, bent), (none, bent, none), (bent, none, none)):
        assert judge(t, lines=(t, Bulge(*parts))).verdicts == (Verdict(Outcome.UNBOUNDED, 2, "px"),)


def test_the_goal_is_closed_and_exact():
    assert judge(tube(CLEAR, (2.0, 4.0, -1.0, 1.0))).verdicts[0].outcome is Outcome.SAFE
    above = math.nextafter(1.0, 2.0)
    assert judge(tube(CLEAR, (2.0, 4.0, -1.0, above))).verdicts == (Verdict(Outcome.MISSES_GOAL, 1, "goal py"),)


def test_a_collision_comes_before_a_missed_goal():
    found = judge(tube((-1.0, 1.0, 4.0, 6.0), CLEAR))
    assert found.verdicts == (Verdict(Outcome.MAY_COLLIDE, 0, "disc"),)


INF, NAN = math.inf, math.nan


@pytest.mark.parametrize(("low", "high"), [(-INF, INF), (INF, INF), (NAN, NAN), (0.0, INF)])
def test_an_overflow_is_unbounded_wherever_it_points(low, high):
    t = tube(CLEAR, CLEAR, GOAL)
    t.lower[0, 1, 1], t.upper[0, 1, 1] = low, high
    found = judge(t)
    assert found.verdicts == (Verdict(Outcome.UNBOUNDED, 1, "py"),)
    assert not bool(torch.isnan(found.clearance).any() | torch.isnan(found.goal_margin).any())


def test_an_overflow_in_a_dimension_without_goal_is_no_nan():
    t = tube(CLEAR, GOAL)
    t.lower[0, 1, 2], t.upper[0, 1, 2] = -math.inf, math.inf
    found = judge(t)
    assert found.verdicts == (Verdict(Outcome.UNBOUNDED, 1, "theta"),)
    assert found.goal_margin[0].tolist() == [0.5, 0.5, math.inf]


def test_one_bad_cell_decides_and_references_are_judged_apart():
    good, bad = tube(CLEAR, GOAL), tube((-1.0, 1.0, 4.0, 6.0), GOAL)
    found = judge(together(good, bad, good, good, good), 0, 0, 1, 1, 1)
    assert [v.outcome for v in found.verdicts] == [Outcome.MAY_COLLIDE, Outcome.SAFE]
    found = judge(together(good, bad, good), 1, 0, 1)
    assert [v.outcome for v in found.verdicts] == [Outcome.MAY_COLLIDE, Outcome.SAFE]


def test_a_reference_without_cells_is_refused_and_not_called_safe():
    with pytest.raises(UsageError, match="every one of 3 references needs cells"):
        judge(together(tube(CLEAR, GOAL), tube(CLEAR, GOAL)), 0, 2)
    with pytest.raises(UsageError, match="every cell a reference"):
        judge(together(tube(CLEAR, GOAL), tube(CLEAR, GOAL)), 0)


def test_the_shortfall_is_zero_where_a_cell_is_safe_and_grows_with_what_is_missing():
    near, far = (2.5, 4.5, -0.5, 0.5), (2.5, 9.0, -0.5, 0.5)
    endless = tube(CLEAR, GOAL)
    endless.lower[0, 1], endless.upper[0, 1] = -math.inf, math.inf
    cells = together(tube(CLEAR, GOAL), tube(CLEAR, near), tube(CLEAR, far), endless)
    safe, missing = shortfall(cells, SCENE, position=(0, 1))
    assert safe.tolist() == [True, False, False, False]
    assert missing[0] == 0 and bool((missing.diff() > 0).all()) and bool(torch.isfinite(missing).all())
    touching = tube(CLEAR, (-1.0, 1.0, 3.0, 4.0), GOAL)
    assert shortfall(touching, SCENE, position=(0, 1))[0].tolist() == [False]


def test_cells_that_are_clear_are_safe_although_their_hull_collides():
    left, right = (-4.0, -1.5, 4.0, 6.0), (1.5, 4.0, 4.0, 6.0)
    tubes = tube(left, (-4.0, -1.5, -1.0, 1.0), GOAL), tube(right, (1.5, 4.0, -1.0, 1.0), GOAL)
    assert judge(together(*tubes)).verdicts[0].outcome is Outcome.SAFE


def test_the_answer_for_all_references():
    safe, maybe = Verdict(Outcome.SAFE), Verdict(Outcome.MISSES_GOAL, 3, "goal px")
    bad = Verdict(Outcome.UNSAFE, 3, "disc")
    assert answer_of([safe, safe]) is Answer.VERIFIED
    assert answer_of([safe, maybe]) is Answer.UNKNOWN
    assert answer_of([maybe, bad, safe]) is Answer.FALSIFIED
    assert answer_of([]) is Answer.UNKNOWN
