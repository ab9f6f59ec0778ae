"""Every relaxation contains its function's graph: drawn intervals, ball arithmetic, no tolerance."""

import math

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.lines import Lines, parallel

from .relaxation_cases import CASES, JUMPING, Case, escapes

cases = pytest.mark.parametrize("case", [*CASES, *JUMPING], ids=str)
DRAWN = settings(
    max_examples=12, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
)


@st.composite
def intervals(draw, case: Case, most: int = 24):
    """Intervals from width 0 and denormal to many periods: on both sides of, at, and across every special point."""
    lowers, uppers = [], []
    for _ in range(draw(st.integers(4, most))):
        anchor = draw(st.sampled_from([*case.special, 1.0, -3.0]))
        scale = st.one_of(
            st.just(0.0), st.floats(-320, -200), st.floats(-20, math.log10(case.largest)), st.floats(-3, 1)
        )
        left, right = (draw(scale) for _ in range(2))
        signs = draw(st.sampled_from([(-1, 1), (1, 1), (-1, -1), (0, 1), (-1, 0), (0, 0)]))
        ends = [anchor + sign * (10.0**size if size else 0.0) for sign, size in zip(signs, (left, right), strict=True)]
        lowers.append(max(min(ends), -case.largest))
        uppers.append(min(max(ends), case.largest))
    return torch.tensor(lowers, dtype=torch.float64), torch.tensor(uppers, dtype=torch.float64)


def drawn(case: Case, data) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    lower, upper = data.draw(intervals(case))
    undefined = torch.tensor([case.undefined(a, b) for a, b in zip(lower.tolist(), upper.tolist(), strict=True)])
    return lower, upper, undefined


@cases
@given(data=st.data())
@DRAWN
def test_the_band_contains_the_graph(case, data):
    lower, upper, undefined = drawn(case, data)
    band = case.band(lower, upper)
    assert bool((band.radius >= 0).all())
    for part in (band.slope, band.offset):
        assert bool(torch.isfinite(part).all())
        assert bool((part[torch.isinf(band.radius)] == 0).all())
    assert bool(torch.isinf(band.radius[undefined]).all())
    defined = ~undefined
    assert escapes(case, lower[defined], upper[defined], [part[defined] for part in band]) == []


@cases
@given(data=st.data())
@DRAWN
def test_the_lines_contain_the_graph(case, data):
    lower, upper, undefined = drawn(case, data)
    lines = case.lines(lower, upper)
    assert bool(torch.isinf(lines.lower_offset[undefined]).all() and torch.isinf(lines.upper_offset[undefined]).all())
    defined = ~undefined
    assert escapes(case, lower[defined], upper[defined], [part[defined] for part in lines]) == []


@cases
@given(data=st.data())
@DRAWN
def test_the_value_range_contains_the_values(case, data):
    lower, upper, undefined = drawn(case, data)
    least, most = case.value_range(lower, upper)
    defined = ~undefined
    assert escapes(case, lower[defined], upper[defined], [least[defined], most[defined]]) == []


def moderate(case: Case, count: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    low, high = case.moderate
    generator = torch.Generator().manual_seed(7)
    ends = low + (high - low) * torch.rand(2, count, dtype=torch.float64, generator=generator)
    lower, upper = ends.amin(0), ends.amax(0)
    for i, point in enumerate(p for p in case.special if low < p < high):
        lower[i], upper[i] = point - 0.4 * (point - low), point + 0.6 * (high - point)
    return lower, upper


def broken(kind: str, band: Band) -> Band:
    slope, offset, radius = band
    return {
        "radius shrunk": Band(slope, offset, 0.99 * radius),
        "slope off": Band(slope * 1.03 + 0.03, offset, radius),
        "offset up": Band(slope, offset + 0.02 * radius, radius),
        "offset down": Band(slope, offset - 0.02 * radius, radius),
    }[kind]


@pytest.mark.parametrize("kind", ["radius shrunk", "slope off", "offset up", "offset down"])
@cases
def test_a_broken_band_is_caught(case, kind):
    lower, upper = moderate(case)
    band = case.band(lower, upper)
    assert escapes(case, lower, upper, band) == []
    assert escapes(case, lower, upper, broken(kind, band)) != []


@pytest.mark.parametrize("part", range(4))
@cases
def test_broken_lines_are_caught(case, part):
    lower, upper = moderate(case)
    lines = list(case.lines(lower, upper))
    lines[part] = lines[part] + 0.03 * (1 if part in (0, 1) else -1)
    assert escapes(case, lower, upper, lines) != []


@cases
def test_a_bound_that_is_not_finite_gives_an_unbounded_relaxation_and_no_nan(case):
    inf, nan = math.inf, math.nan
    lower = torch.tensor([-inf, 1.0, -inf, nan, nan, 1.0, inf, -inf, 1.0], dtype=torch.float64)
    upper = torch.tensor(
        [inf, inf, 1.0, nan, 1.0, nan, inf, -inf, 2.0 if case.name != "tan" else 1.2], dtype=torch.float64
    )
    band, lines = case.band(lower, upper), case.lines(lower, upper)
    assert band.radius[:-1].tolist() == [inf] * 8 and math.isfinite(band.radius[-1])
    assert band.slope[:-1].tolist() == [0.0] * 8 and band.offset[:-1].tolist() == [0.0] * 8
    assert lines.lower_offset[:-1].tolist() == [-inf] * 8 and lines.upper_offset[:-1].tolist() == [inf] * 8
    assert not bool(torch.stack(case.value_range(lower, upper)).isnan().any())


@pytest.mark.parametrize("name", ["sqrt", "log"])
def test_an_interval_with_negative_numbers_has_no_band(name):
    case = next(c for c in CASES if c.name == name)
    lower, upper = (
        torch.tensor([-1.0, -1e-300, -5e-324], dtype=torch.float64),
        torch.tensor([2.0, 1.0, 0.0], dtype=torch.float64),
    )
    assert case.band(lower, upper).radius.tolist() == [math.inf] * 3


@pytest.mark.parametrize("name", ["reciprocal", "power -2", "power -3", "tan"])
def test_an_interval_that_holds_a_pole_has_no_band(name):
    case = next(c for c in CASES if c.name == name)
    pole = 0.5 * math.pi if name == "tan" else 0.0
    lower = torch.tensor([pole - 0.1, pole, pole - 1e-13, pole - 20.0, pole - 1e-320], dtype=torch.float64)
    upper = torch.tensor([pole + 0.1, pole + 1.0, pole + 1e-13, pole + 20.0, pole + 1e-320], dtype=torch.float64)
    assert case.band(lower, upper).radius.tolist() == [math.inf] * 5


@cases
def test_batches_of_any_shape_are_the_entries_one_by_one(case):
    lower, upper = moderate(case, 6)
    flat = case.band(lower, upper)
    shaped = case.band(lower.reshape(2, 1, 3), upper.reshape(2, 1, 3))
    for one, other in zip(flat, shaped, strict=True):
        assert other.shape == (2, 1, 3)
        torch.testing.assert_close(one, other.flatten(), rtol=1e-9, atol=1e-12)


def test_the_edges_of_a_band_are_lines():
    case = next(c for c in CASES if c.name == "tanh")
    lower, upper = moderate(case)
    lines = parallel(case.band(lower, upper))
    assert isinstance(lines, Lines)
    assert escapes(case, lower, upper, lines) == []


@pytest.mark.parametrize(
    "name",
    ["leaky relu 0.1", "sin", "cos", "clamp [-1.0, 1.0]", "tanh", "sigmoid", "atan", "silu", "power 2", "power 3"],
)
def test_gradients_are_finite_also_for_degenerate_intervals(name):
    case = next(c for c in CASES if c.name == name)
    lower = torch.tensor([0.0, 1.0, 0.5 * math.pi, -1e-9, -0.3, -2.0, -9.0], dtype=torch.float64, requires_grad=True)
    upper = torch.tensor([0.0, 1.0, 0.5 * math.pi, 1e-9, 0.4, 1.5, 9.0], dtype=torch.float64, requires_grad=True)
    band = case.band(lower, upper)
    for part in band:
        for gradient in torch.autograd.grad(part.sum(), (lower, upper), retain_graph=True):
            assert bool(torch.isfinite(gradient).all())


@pytest.mark.parametrize("name", ["leaky relu 0.1", "sin", "cos"])
def test_the_radius_gradient_is_that_of_finite_differences(name):
    case = next(c for c in CASES if c.name == name)
    lower = torch.tensor([-0.3, -0.7, 0.4], dtype=torch.float64, requires_grad=True)
    upper = torch.tensor([0.4, 1.1, 1.3], dtype=torch.float64)
    (gradient,) = torch.autograd.grad(case.band(lower, upper).radius.sum(), lower)
    step = 1e-6
    with torch.no_grad():
        difference = (case.band(lower + step, upper).radius - case.band(lower - step, upper).radius) / (2 * step)
    torch.testing.assert_close(gradient, difference, rtol=1e-4, atol=1e-7)
