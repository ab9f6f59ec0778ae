"""The falsifier finds planted violations, replays them, and stays silent on safe loops."""

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from sagemp_cli.dynamics import Unicycle
from sagemp_cli.errors import UsageError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.scenes.scene import Ball, Scene
from sagemp_cli.sets import Box
from sagemp_cli.trackers import Tracker
from sagemp_cli.verification.attack.ascent import simulate
from sagemp_cli.verification.attack.falsifier import falsify, margins, replay

INF = float("inf")


@dataclass(frozen=True)
class Drift:
    """``x+ = x + [0.1, 0] + w``: the reach set at k is known, ``x_0 + [0.1 k, 0] +- k r``."""

    horizon: int = 10
    state_dim: int = 2

    def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
        return x + torch.tensor([0.1, 0.0], dtype=torch.float64) + w


START = Box.around([0.0, 0.0], [0.1, 0.1])
DISTURBANCE = Box.around([0.0, 0.0], [0.02, 0.02])


def scene(*obstacles: Ball, goal=((-INF, -INF), (INF, INF)), half: float = 5.0) -> Scene:
    workspace = Box(torch.tensor([-half, -half]), torch.tensor([half, half]))
    return Scene(workspace, tuple(obstacles), Box(torch.tensor(goal[0]), torch.tensor(goal[1])))


def search(where: Scene, loop=None, start=START, **options):
    generator = torch.Generator().manual_seed(0)
    return falsify(loop or Drift(), start, DISTURBANCE, scene=where, position=(0, 1), generator=generator, **options)


def test_a_violation_that_only_the_worst_disturbance_reaches_is_found_and_replays():
    # At k = 10 the reach set's upper face in y is at 0.3; the ball's lowest point is at 0.295.
    [found] = search(scene(Ball((1.0, 0.795), 0.5, "planted")))
    assert found is not None
    assert (found.kind, found.name, found.step) == ("obstacle", "planted", 10)
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


def test_leaving_the_workspace_names_the_first_step_outside():
    [found] = search(scene(half=0.5), start=Box.around([0.0, 0.0], [0.0, 0.0]))
    assert found is not None and found.kind == "workspace"
    assert not bool((found.states[: found.step].abs() > 0.5).any())
    assert float(found.states[found.step].abs().max()) > 0.5


def test_a_violation_within_rounding_does_not_count():
    x = torch.tensor([0.5 + 1e-12, 0.0], dtype=torch.float64)
    still = torch.tensor([-0.1, 0.0], dtype=torch.float64).expand(10, 2)
    where = scene(half=0.5)
    assert float(margins(x[None], where, (0, 1))[0, 0]) < 0
    assert replay(Drift(), x, still, scene=where, position=(0, 1)) is None
    assert replay(Drift(), x + 1e-6, still, scene=where, position=(0, 1)) is not None


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
        starts,
        Box.around([0.0] * 4, [0.01] * 4),
        scene=where,
        position=(0, 1),
        generator=torch.Generator().manual_seed(1),
    )
    assert found[0] is not None and found[0].name == "ahead"
    assert found[1] is None


def test_wrong_arguments_are_refused_in_one_line():
    with pytest.raises(UsageError, match="restarts must be a positive integer, found 0"):
        search(scene(), restarts=0)
    with pytest.raises(UsageError, match="2 start boxes for 1 references"):
        search(scene(), start=Box(torch.zeros(2, 2), torch.ones(2, 2)))
