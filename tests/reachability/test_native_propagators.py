"""What every native propagator promises: enclosure, exactness on affine maps, batching, honest overflow, errors."""

from dataclasses import dataclass

import pytest
import torch
from inner import attack_tube, inner_estimate
from torch import Tensor

from sagemp_cli.errors import UnsupportedOperationError, UsageError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.crown.best import Best
from sagemp_cli.reachability.crown.crown import Crown
from sagemp_cli.reachability.interval.interval import Interval
from sagemp_cli.sets import Box

from .propagator_cases import DISTURBANCE, START, AffineLoop, EveryOperation, line, rollouts, unicycle_loop

NATIVE = [Interval(), Crown(), Crown(symbols=12, rows=5), Best(), Best(rounds=3, rows=40)]
LINEAR = [p for p in NATIVE if p.name != "interval"]


def name(propagator) -> str:
    return repr(propagator)


@pytest.mark.parametrize("propagator", NATIVE, ids=name)
def test_the_tube_contains_random_corner_and_bang_bang_rollouts(propagator):
    loop = unicycle_loop(line(0.3))
    tube = propagator.propagate(loop, START, DISTURBANCE)
    assert propagator.rigorous and bool(tube.contains(rollouts(loop, START, DISTURBANCE)).all())
    assert torch.equal(tube.lower[0], START.lower) and torch.equal(tube.upper[0], START.upper)


@pytest.mark.parametrize("propagator", NATIVE, ids=name)
def test_the_tube_contains_what_gradient_ascent_finds(propagator):
    loop = unicycle_loop(line(0.3))
    tube = propagator.propagate(loop, START, DISTURBANCE)
    attack = attack_tube(loop, START, DISTURBANCE, tube, count=400, generator=torch.Generator().manual_seed(1))
    assert attack.escapes == 0
    widest = inner_estimate(loop, START, DISTURBANCE, generator=torch.Generator().manual_seed(2), restarts=1)
    margin = 1e-12
    assert bool((tube.lower <= widest.lower + margin).all()) and bool((tube.upper >= widest.upper - margin).all())


@pytest.mark.parametrize("width", [1e-6, 0.1, 0.4])
@pytest.mark.parametrize("propagator", NATIVE, ids=name)
def test_every_operation_is_enclosed(propagator, width):
    loop = EveryOperation()
    start, w = Box.around([0.1, -0.05, 0.2], [width] * 3), Box.around([0.0] * 3, [0.1 * width] * 3)
    tube = propagator.propagate(loop, start, w)
    assert bool(tube.bounded) and bool(tube.contains(rollouts(loop, start, w)).all())


@pytest.mark.parametrize("propagator", LINEAR, ids=name)
def test_tubes_of_affine_loops_are_exact(propagator):
    loop, start, w = AffineLoop(), Box.around([1.0, -1.0], [0.5, 0.2]), Box.around([0.05, 0.0], [0.1, 0.3])
    if getattr(propagator, "symbols", None) is not None:
        pytest.skip("reduction is not exact")
    tube = propagator.propagate(loop, start, w)
    lower, upper = loop.reach(start, w)
    torch.testing.assert_close(tube.lower, lower, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(tube.upper, upper, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("propagator", NATIVE, ids=name)
def test_a_larger_set_has_a_larger_tube_on_an_affine_loop(propagator):
    loop, w = AffineLoop(), Box.around([0.0, 0.0], [0.1, 0.3])
    inner = propagator.propagate(loop, Box.around([1.0, -1.0], [0.4, 0.1]), w)
    outer = propagator.propagate(loop, Box.around([1.0, -1.0], [0.5, 0.2]), w)
    assert bool((outer.lower < inner.lower).all()) and bool((outer.upper > inner.upper).all())


@pytest.mark.parametrize("propagator", NATIVE, ids=name)
def test_a_point_without_disturbance_stays_within_rounding_of_a_point(propagator):
    loop, x = unicycle_loop(line(0.3)), torch.tensor([0.05, -0.02, 0.3, 1.1], dtype=torch.float64)
    zero = torch.zeros(4, dtype=torch.float64)
    tube = propagator.propagate(loop, Box(x, x), Box(zero, zero))
    assert bool(tube.contains(rollouts(loop, Box(x, x), Box(zero, zero), count=1)).all())
    assert 0 < float(tube.width.max()) < 1e-9


@pytest.mark.parametrize("propagator", NATIVE, ids=name)
def test_references_and_cells_in_one_call_get_the_tubes_they_get_alone(propagator):
    references, cells = (line(0.3), line(-0.2)), START.split([2, 1, 1, 1])
    tubes = propagator.propagate(unicycle_loop(*references), cells, DISTURBANCE)
    assert tubes.lower.shape == (2, 2, 13, 4)
    for r, reference in enumerate(references):
        for c in range(2):
            alone = propagator.propagate(unicycle_loop(reference), Box(cells.lower[c], cells.upper[c]), DISTURBANCE)
            torch.testing.assert_close(tubes.lower[r, c], alone.lower, rtol=1e-9, atol=1e-11)
            torch.testing.assert_close(tubes.upper[r, c], alone.upper, rtol=1e-9, atol=1e-11)


@dataclass(frozen=True)
class Cubic:
    horizon: int = 12
    state_dim: int = 1

    def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
        return x * x * x + w


@pytest.mark.parametrize("propagator", NATIVE, ids=name)
def test_an_overflow_gives_infinite_rows_and_spares_the_other_cells(propagator):
    start = Box(torch.tensor([[-0.1], [2.0]]), torch.tensor([[0.1], [3.0]]))
    zero = torch.zeros(1, dtype=torch.float64)
    tube = propagator.propagate(Cubic(), start, Box(zero, zero))
    assert tube.bounded.tolist() == [True, False]
    assert not bool(torch.isnan(tube.lower).any() | torch.isnan(tube.upper).any())
    assert float(tube.lower[1, -1, 0]) == -torch.inf and float(tube.upper[1, -1, 0]) == torch.inf


@dataclass(frozen=True)
class Special:
    horizon: int = 2
    state_dim: int = 2

    def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
        return torch.special.i0(x) + w


@pytest.mark.parametrize("propagator", NATIVE, ids=name)
def test_what_cannot_be_bounded_is_refused_in_one_line(propagator):
    box = Box.around([0.0, 0.0], [0.1, 0.1])
    with pytest.raises(
        UnsupportedOperationError, match="torch operation 'special_i0' has no relaxation .* register it"
    ):
        propagator.propagate(Special(), box, box)
    with pytest.raises(UsageError, match="the start box has 3 dimensions, the loop's state has 2"):
        propagator.propagate(AffineLoop(), Box.around([0.0] * 3, [0.1] * 3), box)
    with pytest.raises(UsageError, match=r"the disturbance must be one box \(d,\), found shape \(1, 2\)"):
        propagator.propagate(AffineLoop(), box, Box(box.lower[None], box.upper[None]))


def test_widths_are_ordered_interval_affine_crown_best():
    loop = unicycle_loop(line(0.3))
    interval, affine, best = (p.propagate(loop, START, DISTURBANCE).width for p in (Interval(), Affine(), Best()))
    crown = Crown().propagate(loop, START, DISTURBANCE).width
    assert bool((best <= affine).all()) and bool((best <= crown).all()) and bool((best < affine).any())
    assert float(affine.mean()) < float(interval.mean()) and float(crown.mean()) < float(affine.mean())
    assert isinstance(loop, ClosedLoop)
