"""Tubes of auto_LiRPA: enclosure, exactness on affine loops, batching, errors."""

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from sagemp_cli.dynamics import Unicycle
from sagemp_cli.errors import ConfigError, UsageError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.reachability.lirpa import adapter as lirpa_adapter
from sagemp_cli.reachability.lirpa.auto_lirpa import AutoLirpa
from sagemp_cli.sets import Box
from sagemp_cli.trackers import Tracker
from sagemp_cli.verification.attack.ascent import simulate

pytestmark = pytest.mark.skipif(
    lirpa_adapter._installed() is None and lirpa_adapter._carried() is None, reason="no auto_LiRPA is installed"
)

K = 5
MODES = [AutoLirpa(), AutoLirpa(mode="one_step"), AutoLirpa(mode="n_step", steps=2), AutoLirpa(method="IBP")]


@dataclass(frozen=True)
class Affine:
    """``x+ = A x + B w + c``."""

    horizon: int = 4
    state_dim: int = 2

    def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
        a = torch.tensor([[0.9, 0.3], [-0.2, 0.8]], dtype=torch.float64)
        return x @ a.T + 0.5 * w + (0.1 * k)


def unicycle_loop(*references: Tensor) -> ClosedLoop:
    torch.manual_seed(0)
    wide = [10.0] * 4
    dynamics = Unicycle(
        dt=0.1, control_lower=[-2.0] * 2, control_upper=[2.0] * 2, state_lower=[-v for v in wide], state_upper=wide
    )
    tracker = Tracker(state_dim=4, control_dim=2, lookahead=3, hidden=[8, 8])
    return ClosedLoop(dynamics, tracker, torch.stack(references) if len(references) > 1 else references[0])


def line(heading: float) -> Tensor:
    t = 0.1 * torch.arange(K + 1, dtype=torch.float64)
    one = torch.ones_like(t)
    return torch.stack([t, heading * t, heading * one, one], dim=-1)


START = Box.around([0.0, 0.0, 0.1, 1.0], [0.3, 0.3, 0.2, 0.1])
DISTURBANCE = Box.around([0.0] * 4, [0.05, 0.05, 0.1, 0.1])


@pytest.mark.parametrize("propagator", MODES, ids=lambda p: f"{p.mode}-{p.method}")
def test_the_tube_contains_random_and_bang_bang_rollouts(propagator):
    loop = unicycle_loop(line(0.3))
    tube = propagator.propagate(loop, START, DISTURBANCE)
    generator = torch.Generator().manual_seed(2)
    start = START.sample(400, generator)
    w = DISTURBANCE.sample(400 * K, generator).reshape(400, K, 4)
    w[200:] = torch.where(w[200:] > 0, DISTURBANCE.upper, DISTURBANCE.lower)
    start[300:] = torch.where(start[300:] > START.center, START.upper, START.lower)
    with torch.no_grad():
        states, _ = loop.rollout(start, w)
    # Both sides are plain float64: what is claimed is claimed up to rounding.
    assert float(torch.maximum(states - tube.upper, tube.lower - states).max()) < 1e-13
    assert torch.equal(tube.lower[0], START.lower) and torch.equal(tube.upper[0], START.upper)
    assert not propagator.rigorous and propagator.name == "auto_lirpa"


def test_one_shot_keeps_what_boxes_after_each_step_forget():
    loop = unicycle_loop(line(0.3))
    widths = [p.propagate(loop, START, DISTURBANCE).width[-1].mean() for p in MODES]
    one_shot, one_step, n_step, intervals = widths
    assert one_shot < n_step < one_step < intervals


def test_one_shot_is_exact_on_an_affine_loop():
    loop = Affine()
    start, disturbance = Box.around([1.0, -1.0], [0.5, 0.2]), Box.around([0.0, 0.0], [0.1, 0.3])
    tube = AutoLirpa().propagate(loop, start, disturbance)
    a = torch.tensor([[0.9, 0.3], [-0.2, 0.8]], dtype=torch.float64)
    center, power, radius = start.center, torch.eye(2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    for k in range(loop.horizon):
        center = a @ center + 0.1 * k
        radius = radius + 0.5 * power.abs() @ disturbance.radius
        power = a @ power
        expected = radius + power.abs() @ start.radius
        torch.testing.assert_close(tube.upper[k + 1], center + expected, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(tube.lower[k + 1], center - expected, rtol=1e-12, atol=1e-12)


def test_a_point_without_disturbance_stays_a_point():
    loop, x = Affine(), torch.tensor([0.3, 0.7], dtype=torch.float64)
    zero = torch.zeros(2, dtype=torch.float64)
    tube = AutoLirpa(mode="one_step").propagate(loop, Box(x, x), Box(zero, zero))
    torch.testing.assert_close(tube.lower, simulate(loop, x, torch.zeros(4, 2, dtype=torch.float64)))
    assert float(tube.width.max()) < 1e-13


def test_cells_and_references_in_a_batch_get_the_tubes_they_get_alone():
    references = line(0.3), line(-0.2)
    cells = START.split([2, 1, 1, 1])
    batch = unicycle_loop(*references)
    batch = ClosedLoop(batch.dynamics, batch.tracker, batch.references[:, None])
    propagator = AutoLirpa(mode="one_step")
    tubes = propagator.propagate(batch, cells, DISTURBANCE)
    assert tubes.lower.shape == (2, 2, K + 1, 4)
    for r, reference in enumerate(references):
        for c in range(2):
            alone = propagator.propagate(unicycle_loop(reference), Box(cells.lower[c], cells.upper[c]), DISTURBANCE)
            torch.testing.assert_close(tubes.lower[r, c], alone.lower, rtol=1e-12, atol=1e-12)
            torch.testing.assert_close(tubes.upper[r, c], alone.upper, rtol=1e-12, atol=1e-12)


def test_an_overflow_gives_infinite_rows_and_spares_the_other_cells():
    @dataclass(frozen=True)
    class Cubic:
        horizon: int = 12
        state_dim: int = 1

        def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
            return x * x * x + w

    start = Box(torch.tensor([[-0.1], [2.0]]), torch.tensor([[0.1], [3.0]]))
    zero = torch.zeros(1, dtype=torch.float64)
    tube = AutoLirpa(mode="one_step").propagate(Cubic(), start, Box(zero, zero))
    assert tube.bounded.tolist() == [True, False]
    assert not bool(torch.isnan(tube.lower).any() | torch.isnan(tube.upper).any())


def test_wrong_options_and_boxes_are_refused_in_one_line():
    with pytest.raises(ConfigError, match="mode must be one of one_shot, one_step, n_step, found 'all'"):
        AutoLirpa(mode="all")
    with pytest.raises(ConfigError, match="method must be one of CROWN, IBP, found 'alpha'"):
        AutoLirpa(method="alpha")
    with pytest.raises(ConfigError, match="steps must be a positive integer, found 0"):
        AutoLirpa(steps=0)
    with pytest.raises(UsageError, match="the start box has 4 dimensions, the loop's state has 2"):
        AutoLirpa().propagate(Affine(), START, DISTURBANCE)
