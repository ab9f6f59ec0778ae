"""The falsifier finds planted violations, replays them, and stays silent on safe loops."""

import dataclasses
import math
from dataclasses import dataclass
from fractions import Fraction

import pytest
import torch
from torch import Tensor

from sagemp_cli.dynamics import Dynamics, Unicycle
from sagemp_cli.errors import UsageError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.problem import Problem
from sagemp_cli.scenes.scene import Ball, Scene
from sagemp_cli.sets import Between, Box
from sagemp_cli.trackers import Tracker
from sagemp_cli.verification.attack.ascent import simulate
from sagemp_cli.verification.attack.falsifier import falsify, replay
from sagemp_cli.verification.attack.rigorous_replay import Replay, inner

INF = float("inf")


@dataclass(frozen=True)
class Drift:
    """``x+ = x + [0.1, 0] + w``: the reach set at k is known, ``x_0 + [0.1 k, 0] +- k r``."""

    horizon: int = 10
    state_dim: int = 2

    def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
        return x + torch.tensor([0.1, 0.0], dtype=torch.float64) + w


class Point(Dynamics):
    """The robot of these loops: of it only the position counts."""

    state_names = ("px", "py")
    state_units = ("m", "m")
    control_names = ("vx", "vy")
    control_units = ("m/s", "m/s")
    position = (0, 1)

    def derivative(self, x: Tensor, u: Tensor) -> Tensor:
        return u


def claim(where: Scene, start: Box, disturbance: Box, horizon: int = 10) -> Problem:
    sides = {"lower": [-9.0] * 2, "upper": [9.0] * 2}
    limits = {f"{of}_{side}": value for of in ("state", "control") for side, value in sides.items()}
    return Problem(Point(dt=0.1, **limits), where, start, disturbance, horizon)


def violations(loop, x: Tensor, w: Tensor, problem: Problem) -> Tensor:
    """What is certainly broken at the samples 0 to K - 1, and of the goal at K."""
    at_samples = torch.zeros(loop.horizon, len(problem.scene.constraint_names), dtype=torch.float64)
    return Replay.of(loop, x, w, problem).broken(at_samples)


START = Box.around([0.0, 0.0], [0.1, 0.1])
DISTURBANCE = Box.around([0.0, 0.0], [0.02, 0.02])


def scene(*obstacles: Ball, goal=((-INF, -INF), (INF, INF)), half: float = 5.0) -> Scene:
    workspace = Box(torch.tensor([-half, -half]), torch.tensor([half, half]))
    return Scene(workspace, tuple(obstacles), Box(torch.tensor(goal[0]), torch.tensor(goal[1])))


def search(where: Scene, loop=None, start=START, **options):
    generator = torch.Generator().manual_seed(0)
    return falsify(loop or Drift(), claim(where, start, DISTURBANCE), generator=generator, **options)


def test_a_violation_that_only_the_worst_disturbance_reaches_is_found_and_replays():
    # At k = 10 the reach set's upper face in y is at 0.3; the ball's lowest point is at 0.295.
    [found] = search(scene(Ball((1.0, 0.795), 0.5, "planted")))
    assert found is not None and found.proved
    assert (found.kind, found.name) == ("obstacle", "planted") and 9.7 < found.step + found.fraction <= 10
    assert 0 < found.depth <= 0.0051
    assert bool(START.contains(found.start)) and bool(DISTURBANCE.contains(found.disturbances).all())
    assert torch.equal(simulate(Drift(), found.start, found.disturbances), found.states)


def test_a_loop_that_keeps_clear_is_not_accused():
    # The nearest point of the reach set at k = 10 is (1, 0.3): 0.005 m away.
    assert search(scene(Ball((1.0, 0.805), 0.5, "near"), goal=((0.69, -0.31), (1.31, 0.31)))) == [None]


def test_a_missed_goal_is_found():
    [found] = search(scene(goal=((0.71, -INF), (INF, INF))))
    assert found is not None and (found.kind, found.name, found.step) == ("goal", "goal", 10)
    assert found.depth == pytest.approx(0.01, abs=1e-3)


def test_leaving_the_workspace_names_the_time_when_it_is_left():
    [found] = search(scene(half=0.5), start=Box.around([0.0, 0.0], [0.0, 0.0]))
    assert found is not None and found.kind == "workspace" and found.proved and 0 < found.fraction < 1
    before, after = found.states[found.step], found.states[found.step + 1]
    assert float(before.abs().max()) <= 0.5 < float(after.abs().max())
    left = before + found.fraction * (after - before)
    assert 0 < float(left.abs().max()) - 0.5 < 1e-6


def test_an_obstacle_that_only_a_line_between_two_samples_touches_is_found_and_when():
    # Without disturbance the samples are at 0, 0.1, 0.2, ...: this disc lies between two of them.
    still = Box.around([0.0, 0.0], [0.0, 0.0])
    problem = claim(scene(Ball((0.55, 0.0), 0.01, "pin")), Box.around([0.0, 0.0], [0.004, 0.004]), still)
    [found] = falsify(Drift(), problem, generator=torch.Generator().manual_seed(0))
    assert found is not None and found.proved and (found.kind, found.name, found.step) == ("obstacle", "pin", 5)
    entered = found.states[5] + found.fraction * (found.states[6] - found.states[5])
    assert 0 <= 0.01 - float((entered - torch.tensor([0.55, 0.0], dtype=torch.float64)).norm()) < 1e-6
    samples = dataclasses.replace(problem, between=Between.SAMPLES)
    assert falsify(Drift(), samples, generator=torch.Generator().manual_seed(0)) == [None]


@dataclass(frozen=True)
class Along:
    """``x+ = x + step``: in real arithmetic ``x_0 + K step``, of which float64 makes what it can."""

    by: float = 0.1
    horizon: int = 100
    state_dim: int = 2

    def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
        return x + torch.tensor([self.by, 0.0], dtype=torch.float64) + w


def goal_from(lower: float) -> Scene:
    """A goal that is reached from this coordinate on."""
    endless = Box(torch.full((2,), -INF), torch.full((2,), INF))
    return Scene(endless, (), Box(torch.tensor([lower, -INF], dtype=torch.float64), torch.full((2,), INF)))


def end_in_float64(at: float, by: float, horizon: int) -> float:
    x = at
    for _ in range(horizon):
        x += by
    return x


@pytest.mark.parametrize("at", [5e5, 5e6])
@pytest.mark.parametrize("by", [0.1, 0.3, 0.7])
def test_a_goal_that_real_arithmetic_reaches_is_not_called_missed_though_float64_misses_it(at, by):
    loop = Along(by)
    real = Fraction(at) + loop.horizon * Fraction(by)
    lower = math.nextafter(float(real), -INF)
    assert Fraction(lower) < real - Fraction(1, 10**12)  # X_I is 2e-12 wide: the goal is reached from all of it
    start, still = Box.around([at, 0.0], [1e-12, 0.0]), Box.around([0.0, 0.0], [0.0, 0.0])
    [found] = falsify(loop, claim(goal_from(lower), start, still), generator=torch.Generator().manual_seed(0))
    assert found is None or not found.proved
    assert (found is not None) == (min(end_in_float64(x, by, loop.horizon) for x in boundary(start)) < lower)


def boundary(start: Box) -> list[float]:
    return [float(start.lower[0]), float(start.center[0]), float(start.upper[0])]


def test_some_of_these_goals_are_missed_in_float64_by_more_than_a_nanometre():
    """So the test above tests something, and no absolute margin would do."""
    missed = [
        float(Fraction(at) + 100 * Fraction(by)) - end_in_float64(at, by, 100)
        for at in (5e5, 5e6)
        for by in (0.1, 0.3, 0.7)
    ]
    assert max(missed) > 1e-9


@pytest.mark.parametrize("at", [0.0, 5e5, 5e6])
def test_a_goal_that_is_missed_by_more_than_rounding_is_proved_missed(at):
    loop, still = Along(), Box.around([0.0, 0.0], [0.0, 0.0])
    real = Fraction(at) + loop.horizon * Fraction(loop.by)
    lower = float(real) + 1e-14 * max(at, 1.0) * 100
    problem = claim(goal_from(lower), Box.around([at, 0.0], [1e-12, 0.0]), still)
    [found] = falsify(loop, problem, generator=torch.Generator().manual_seed(0))
    assert found is not None and found.proved and (found.kind, found.state, found.step) == ("goal", 0, 100)


def test_a_goal_missed_by_1e_15_is_refuted_only_if_real_arithmetic_misses_it():
    """The real end of 50 steps of 0.01 from 0.1 lies between two floats; goals begin just below and just above it."""
    loop, still = Along(0.01, 50), Box.around([0.0, 0.0], [0.0, 0.0])
    real = Fraction(0.1) + 50 * Fraction(0.01)
    verdicts = {}
    for ulps in (-1000, -20, -9, -3, -1, 0, 1, 3, 9, 20, 1000):  # 9 of them are 1e-15
        lower = 0.6 + ulps * 2.0**-53
        problem = claim(goal_from(lower), Box.around([0.1, 0.0], [0.0, 1e-3]), still)
        [found] = falsify(loop, problem, generator=torch.Generator().manual_seed(0), restarts=1)
        verdicts[ulps] = found is not None and found.proved
        assert not verdicts[ulps] or real < Fraction(lower)
    assert verdicts[1000] and not verdicts[-1000]


def test_what_is_proved_starts_inside_the_real_box_and_not_in_the_float_outside_of_it():
    start = Box.around([0.1, 0.0], [0.05, 0.0])
    kept = inner(start)
    assert Fraction(float(kept.lower[0])) >= Fraction(0.1) - Fraction(0.05)
    assert Fraction(float(kept.upper[0])) <= Fraction(0.1) + Fraction(0.05)
    assert torch.equal(kept.lower[1], start.lower[1]) and torch.equal(kept.upper[1], start.upper[1])
    # Only from the outermost floats, which rounding outwards added, is the goal missed.
    real = Fraction(0.1) - Fraction(0.05)
    loop = Along(0.5, 1)
    lower = math.nextafter(float(real + Fraction(1, 2)), 0.0)
    assert Fraction(lower) <= real + Fraction(1, 2)
    problem = claim(goal_from(lower), start, Box.around([0.0, 0.0], [0.0, 0.0]))
    [found] = falsify(loop, problem, generator=torch.Generator().manual_seed(0))
    assert found is None or not found.proved


def test_a_disturbance_set_too_narrow_to_know_its_points_proves_nothing():
    where, x, w = goal_from(1e9), torch.zeros(2, dtype=torch.float64), torch.zeros(100, 2, dtype=torch.float64)
    narrow = Box.around([5e6, 0.0], [1e-12, 0.0])
    wide = Box.around([0.0, 0.0], [0.1, 0.1])
    assert not bool(violations(Along(), x, w + narrow.center, claim(where, wide, narrow)).any())
    assert bool(violations(Along(), x, w, claim(where, wide, wide))[-1, -1])


@pytest.mark.parametrize("ulps", range(9))
def test_points_are_certain_of_what_is_a_point_or_wide_enough_to_have_floats_two_inside(ulps):
    box = Box(*torch.tensor([[1.0, 0.0], [1.0 + ulps * 2.0**-52, 0.0]], dtype=torch.float64))
    problem = claim(goal_from(1e9), Box.around([0.0, 0.0], [0.1, 0.1]), box)
    still = torch.zeros(100, 2, dtype=torch.float64)
    assert (Replay.of(Along(), torch.zeros(2).double(), still, problem).tube is None) == (0 < ulps < 4)
    kept = inner(box)
    moved = 2.0 if ulps >= 4 else 0.0
    assert float(kept.lower[0] - 1.0) == moved * 2.0**-52 and float(kept.upper[0] - 1.0) == (ulps - moved) * 2.0**-52


def test_a_rollout_that_breaks_nothing_is_no_counterexample():
    still = torch.zeros(10, 2, dtype=torch.float64)
    x = torch.zeros(2, dtype=torch.float64)
    assert replay(Drift(), x, still, claim(scene(), START, DISTURBANCE)) is None
    found = replay(Drift(), x, still, claim(scene(half=0.45), START, DISTURBANCE))
    assert found is not None and found.proved and (found.kind, found.step) == ("workspace", 4)
    assert found.fraction == pytest.approx(0.5, abs=1e-6)


def test_what_only_touches_a_wall_is_not_the_step_at_which_it_is_broken():
    """The rollout is on the wall at 0 and a float beyond it from 1 on, which proves nothing."""
    start, still = Box.around([0.5, 0.0], [1.0, 0.0]), Box.around([0.0, 0.0], [0.0, 0.0])
    problem = dataclasses.replace(claim(scene(half=1.0), start, still), between=Between.SAMPLES)
    found = replay(Along(2.0**-52, 10), torch.tensor([1.0, 0.0]).double(), torch.zeros(10, 2).double(), problem)
    assert found is not None and not found.proved and (found.kind, found.step) == ("workspace", 1)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_state_that_misses_the_goal_is_the_one_that_does_at_the_end(side):
    @dataclass(frozen=True)
    class Jumps:
        horizon: int = 2
        state_dim: int = 2

        def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
            return x + side * torch.tensor([[4.0, 0.0], [-4.0, 0.5]][k], dtype=torch.float64) + w

    still = torch.zeros(2, 2, dtype=torch.float64)
    problem = claim(scene(goal=((-0.2, -0.2), (0.2, 0.2))), START, DISTURBANCE, 2)
    found = replay(Jumps(), torch.zeros(2, dtype=torch.float64), still, problem)
    assert found is not None and (found.kind, found.step, found.state) == ("goal", 2, 1)


def test_an_overflowing_rollout_is_no_counterexample():
    @dataclass(frozen=True)
    class Explodes:
        horizon: int = 12
        state_dim: int = 2

        def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
            return x * x * x * 1e9 + w

    # Nothing is wrong before it overflows: the workspace is the whole plane.
    assert search(scene(half=INF), loop=Explodes()) == [None]


def test_references_are_searched_together_and_answered_one_by_one():
    torch.manual_seed(0)
    limits = [10.0] * 4
    dynamics = Unicycle(
        dt=0.1, control_lower=[-1.0] * 2, control_upper=[1.0] * 2, state_lower=[-v for v in limits], state_upper=limits
    )
    tracker = Tracker(state_dim=4, control_dim=2, lookahead=2, hidden=[4], control_scale=[0.01, 0.01])
    references = torch.zeros(2, 9, 4, dtype=torch.float64)
    starts = Box.around([[0.0, 0.0, 0.0, 1.0], [0.0, 3.0, 0.0, 1.0]], [[0.05, 0.05, 0.0, 0.0]] * 2)
    where = Scene(
        Box(torch.tensor([-5.0, -5.0]), torch.tensor([5.0, 5.0])),
        (Ball((0.8, 0.0), 0.2, "ahead"),),
        Box(torch.full((4,), -INF), torch.full((4,), INF)),
    )
    found = falsify(
        ClosedLoop(dynamics, tracker, references),
        Problem(dynamics, where, starts, Box.around([0.0] * 4, [0.01] * 4), 8),
        generator=torch.Generator().manual_seed(1),
    )
    assert found[0] is not None and found[0].name == "ahead"
    assert found[1] is None


def test_wrong_arguments_are_refused_in_one_line():
    with pytest.raises(UsageError, match="restarts must be a positive integer, found 0"):
        search(scene(), restarts=0)
    with pytest.raises(UsageError, match="2 start boxes for 1 references"):
        search(scene(), start=Box(torch.zeros(2, 2), torch.ones(2, 2)))


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_faces_of_the_workspace_belong_to_it(side):
    """Row 0 of a tube is the start itself, without rounding: on the face nothing is broken, beyond it something is."""
    half = torch.tensor(0.5, dtype=torch.float64)
    still = torch.zeros(10, 2, dtype=torch.float64)
    problem = claim(scene(half=0.5), Box.around([0.0] * 2, [1.0] * 2), DISTURBANCE)
    on = torch.stack([side * half, torch.zeros_like(half)])
    beyond = torch.stack([side * torch.nextafter(half, half + 1), torch.zeros_like(half)])
    assert not bool(violations(Drift(), on, still, problem)[0, 0])
    assert bool(violations(Drift(), beyond, still, problem)[0, 0])
