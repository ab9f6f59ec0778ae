"""How tight the relaxations are: against the best band and the best lines, found by brute force."""

import math

import pytest
import torch

from sagemp_cli.reachability.relaxations import clamp, leaky_relu, silu, sine, tanh

from .relaxation_cases import CASES

cases = pytest.mark.parametrize("case", CASES, ids=str)
# A jump has no best band on a grid, and a point near it has the jump's radius.
smooth = pytest.mark.parametrize("case", [c for c in CASES if "as torch" not in c.name], ids=str)
curved = pytest.mark.parametrize(
    "case", [c for c in CASES if not c.name.startswith(("leaky", "abs", "clamp", "elu", "softplus 3.7"))], ids=str
)
GRID = torch.linspace(0.0, 1.0, 1501, dtype=torch.float64)


def _intervals(case, count: int = 60) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(11)
    low, high = case.moderate
    ends = low + (high - low) * torch.rand(2, count, dtype=torch.float64, generator=generator)
    lower, upper = ends.amin(0), ends.amax(0)
    wide = upper - lower > 0.1
    return lower[wide], upper[wide]


def _grid(case, lower: torch.Tensor, upper: torch.Tensor) -> torch.Tensor:
    """Points of each interval, the function's special ones among them, in order."""
    x = lower[:, None] + (upper - lower)[:, None] * GRID
    special = torch.tensor(case.special, dtype=torch.float64).expand(len(lower), -1)
    special = torch.minimum(torch.maximum(special, lower[:, None]), upper[:, None])
    return torch.cat([x, special], dim=1).sort(dim=1).values


def _golden(objective, low: torch.Tensor, high: torch.Tensor) -> torch.Tensor:
    """Smallest value of convex functions of the slope."""
    share = (math.sqrt(5) - 1) / 2
    for _ in range(60):
        left, right = high - share * (high - low), low + share * (high - low)
        better = objective(left) < objective(right)
        low, high = torch.where(better, low, left), torch.where(better, right, high)
    return objective(0.5 * (low + high))


def _best(case, lower, upper):
    """Radius of the best band, and heights at the middle of the best upper and lower line."""
    x = _grid(case, lower, upper)
    y, middle = case.value(x), 0.5 * (lower + upper)
    run = x[:, 1:] - x[:, :-1]
    secant = torch.where(run > 1e-9, (y[:, 1:] - y[:, :-1]) / run, ((y[:, -1] - y[:, 0]) / (upper - lower))[:, None])
    low, high = secant.amin(1) - 1e-6, secant.amax(1) + 1e-6

    def excess(slope):
        return y - slope[:, None] * x

    return (
        _golden(lambda a: 0.5 * (excess(a).amax(1) - excess(a).amin(1)), low, high),
        _golden(lambda a: excess(a).amax(1) + a * middle, low, high),
        -_golden(lambda a: -excess(a).amin(1) - a * middle, low, high),
    )


@smooth
def test_the_band_is_nearly_the_best_one(case):
    lower, upper = _intervals(case)
    best, _, _ = _best(case, lower, upper)
    radius = case.band(lower, upper).radius
    # The grid misses the extremes by a few millionths of the curvature.
    assert float((radius - case.ratio * best).max()) <= 2e-5 * float(best.max())


@smooth
def test_the_lines_are_nearly_those_of_smallest_area(case):
    lower, upper = _intervals(case)
    radius, above, below = _best(case, lower, upper)
    lines, middle = case.lines(lower, upper), 0.5 * (lower + upper)
    if case.name.startswith(("leaky", "abs")):  # any slope between the rays' has the same height at the kink
        below = torch.minimum(below, lines.lower_slope * middle)
    slack = 0.01 * radius + 1e-4 * float(radius.max())
    assert bool((lines.upper_slope * middle + lines.upper_offset <= above + slack).all())
    assert bool((lines.lower_slope * middle + lines.lower_offset >= below - slack).all())


@cases
def test_the_value_range_is_that_of_the_values(case):
    lower, upper = _intervals(case)
    values = case.value(_grid(case, lower, upper))
    least, most = case.value_range(lower, upper)
    slack = 1e-5 * (1 + values.abs().amax(1)) + (2e-3 if "as torch" in case.name else 0.0)
    assert bool((least >= values.amin(1) - slack).all())
    assert bool((most <= values.amax(1) + slack).all())


@smooth
def test_a_point_has_a_radius_of_rounding_only(case):
    x = torch.tensor([0.3, 0.7, 1.2], dtype=torch.float64)
    band = case.band(x, x)
    assert float(band.radius.max()) <= 1e-13 * float(1 + case.value(x).abs().max())


@curved
def test_the_radius_shrinks_with_the_square_of_the_width(case):
    x = torch.tensor([0.4, 0.9], dtype=torch.float64)
    wide, narrow = (case.band(x - w, x + w).radius for w in (1e-2, 1e-3))
    assert bool((narrow <= wide / 90).all())


def test_affine_pieces_are_exact():
    lower, upper = torch.tensor([0.5, 1e-300, -3.0, 0.0]).double(), torch.tensor([2.0, 1.0, -1.0, 4.0]).double()
    band = leaky_relu.band(lower, upper, 0.1)
    assert band.slope.tolist() == [1.0, 1.0, 0.1, 1.0]
    assert float(band.radius.max()) <= 1e-249
    band = clamp.band(torch.tensor([-0.5, -3.0, 1.0]).double(), torch.tensor([0.7, -1.0, 2.0]).double(), -1.0, 1.0)
    assert band.slope.tolist() == [1.0, 0.0, 0.0]
    assert band.offset.tolist() == [0.0, -1.0, 1.0]
    assert float(band.radius.max()) <= 1e-15


@pytest.mark.parametrize("band", [tanh.band, sine.sine_band, sine.cosine_band, lambda a, b: leaky_relu.band(a, b, 0.1)])
def test_a_larger_interval_has_no_smaller_radius(band):
    generator = torch.Generator().manual_seed(5)
    inner = torch.randn(2, 200, dtype=torch.float64, generator=generator) * 2
    more = torch.rand(2, 200, dtype=torch.float64, generator=generator)
    lower, upper = inner.amin(0), inner.amax(0)
    assert bool((band(lower - more[0], upper + more[1]).radius >= band(lower, upper).radius * (1 - 1e-2)).all())


def test_figures_known_in_closed_form():
    one = torch.tensor([1.0], dtype=torch.float64)
    # ReLU on [-1, 1]: radius 1/4; x^2 has 1/2 on [-1, 1]; sine over whole periods has 1.
    assert float(leaky_relu.band(-one, one, 0.0).radius) == pytest.approx(0.25)
    assert float(next(c for c in CASES if c.name == "power 2").band(-one, one).radius) == pytest.approx(0.5)
    assert float(next(c for c in CASES if c.name == "power 3").band(-one, one).radius) == pytest.approx(0.25, rel=1e-3)
    assert float(sine.sine_band(-500 * one, 500 * one).radius) == pytest.approx(1.0, abs=5e-3)
    assert float(sine.sine_band(-1e-1 * one, 1e-1 * one).radius) == pytest.approx(1e-3 / 24, rel=1e-2)


def test_the_derivative_of_silu_at_the_point_found_is_the_slope_asked_for():
    generator = torch.Generator().manual_seed(7)
    start, end = (2.0 * torch.rand(2, 200, dtype=torch.float64, generator=generator)).sort(dim=0).values
    at_start, at_end = silu.CURVE.derivative(start), silu.CURVE.derivative(end)
    slope = at_start + (at_end - at_start) * torch.rand(200, dtype=torch.float64, generator=generator)
    t = next(piece for piece in silu.CURVE.pieces if piece.convex).touch(slope, start, end)
    assert bool((start <= t).all()) and bool((t <= end).all())
    assert bool(((silu.CURVE.derivative(t) - slope).abs() <= 1e-6 * (at_end - at_start) + 1e-15).all())
