"""The inner estimate lies inside every tube and is exact on affine loops; attacks catch a tube that is too small."""

from dataclasses import dataclass

import pytest
import torch
from inner import attack_tube, inner_estimate
from torch import Tensor

from sagemp_cli.errors import UsageError
from sagemp_cli.sets import Box, Tube

A = torch.tensor([[0.9, 0.3], [-0.2, 0.8]], dtype=torch.float64)
START = Box.around([1.0, -1.0], [0.5, 0.2])
DISTURBANCE = Box.around([0.0, 0.1], [0.1, 0.3])


@dataclass(frozen=True)
class Affine:
    """``x+ = A x + 0.5 w``."""

    horizon: int = 8
    state_dim: int = 2

    def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
        return x @ A.T + 0.5 * w


@dataclass(frozen=True)
class Pendulum:
    """A damped pendulum, Euler step 0.1."""

    horizon: int = 12
    state_dim: int = 2

    def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
        angle, speed = x[..., 0], x[..., 1]
        return x + 0.1 * (torch.stack([speed, -torch.sin(angle) - speed], dim=-1) + w)


def exact_tube(loop: Affine) -> Tube:
    """Closed form: ``A^k X_0`` plus the sum of ``A^j 0.5 W``, box hulls of zonotopes."""
    center, reach, power = START.center, torch.zeros(2, dtype=torch.float64), torch.eye(2, dtype=torch.float64)
    lower, upper = [START.lower], [START.upper]
    for _ in range(loop.horizon):
        center = A @ center + 0.5 * DISTURBANCE.center
        reach = reach + 0.5 * power.abs() @ DISTURBANCE.radius
        power = A @ power
        radius = reach + power.abs() @ START.radius
        lower.append(center - radius)
        upper.append(center + radius)
    return Tube(torch.stack(lower), torch.stack(upper))


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(3)


def test_the_inner_estimate_of_an_affine_loop_is_its_reach_set():
    inner = inner_estimate(Affine(), START, DISTURBANCE, generator=generator())
    exact = exact_tube(Affine())
    torch.testing.assert_close(inner.lower, exact.lower, rtol=1e-13, atol=1e-13)
    torch.testing.assert_close(inner.upper, exact.upper, rtol=1e-13, atol=1e-13)
    assert float((inner.ratio(exact) - 1).abs().max()) < 1e-12


def test_it_is_far_wider_than_random_rollouts_and_found_by_few_ascents():
    inner = inner_estimate(Pendulum(), START, DISTURBANCE, generator=generator(), restarts=1)
    g = generator()
    states = [START.sample(2000, g)]
    for k in range(12):
        states.append(Pendulum().step(k, states[-1], DISTURBANCE.sample(2000, g)))
    random = torch.stack(states, dim=1)
    assert bool((inner.lower <= random.amin(0)).all()) and bool((random.amax(0) <= inner.upper).all())


def test_more_restarts_and_chunks_never_shrink_below_a_single_search():
    one = inner_estimate(Affine(), START, DISTURBANCE, generator=generator(), steps=[8], restarts=1)
    cut = inner_estimate(Affine(), START, DISTURBANCE, generator=generator(), restarts=1, chunk=3)
    torch.testing.assert_close(one.lower[8], cut.lower[8], rtol=1e-13, atol=1e-13)
    assert bool((one.width <= cut.width + 1e-12).all())


def test_the_ratio_is_nan_where_nothing_varies():
    point = Box(torch.zeros(2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64))
    inner = inner_estimate(Affine(), point, point, generator=generator())
    assert bool(torch.isnan(inner.ratio(Tube(inner.lower, inner.upper))).all())


def test_no_rollout_escapes_the_exact_tube():
    attack = attack_tube(Affine(), START, DISTURBANCE, exact_tube(Affine()), count=4000, generator=generator())
    assert attack.escapes == 0 and 4000 - 3 <= attack.rollouts <= 4000 + 3
    assert -1e-12 < attack.excess < 1e-12  # the ascents touch the faces


@pytest.mark.parametrize(("row", "coordinate"), [(3, 0), (8, 1)])
def test_a_tube_too_small_by_a_millionth_is_caught(row, coordinate):
    tube = exact_tube(Affine())
    upper = tube.upper.clone()
    upper[row, coordinate] -= 1e-6
    attack = attack_tube(Affine(), START, DISTURBANCE, Tube(tube.lower, upper), count=4000, generator=generator())
    assert attack.escapes > 0 and attack.outside >= attack.escapes
    assert (attack.step, attack.coordinate) == (row, coordinate)
    assert attack.excess == pytest.approx(1e-6, rel=1e-3)


def test_an_infinite_tube_contains_even_rollouts_that_overflow():
    @dataclass(frozen=True)
    class Explodes:
        horizon: int = 12
        state_dim: int = 2

        def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
            return (x + w) * (x + w) * (x + w) * 1e9

    everything = torch.full((13, 2), torch.inf, dtype=torch.float64)
    tube = Tube(-everything, everything)
    assert attack_tube(Explodes(), START, DISTURBANCE, tube, count=100, generator=generator()).escapes == 0
    finite = Tube(-everything.clamp(max=1e300), everything.clamp(max=1e300))
    assert attack_tube(Explodes(), START, DISTURBANCE, finite, count=100, generator=generator()).escapes > 50


def test_wrong_arguments_are_refused_in_one_line():
    with pytest.raises(UsageError, match=r"steps must lie in 0\.\.8, found \[9\]"):
        inner_estimate(Affine(), START, DISTURBANCE, generator=generator(), steps=[9])
    with pytest.raises(UsageError, match="count must be a positive integer, found 0"):
        attack_tube(Affine(), START, DISTURBANCE, exact_tube(Affine()), count=0, generator=generator())
    with pytest.raises(UsageError, match=r"tube must have shape \(9, 2\), found \(7, 2\)"):
        attack_tube(Affine(), START, DISTURBANCE, exact_tube(Affine(6)), count=1, generator=generator())
