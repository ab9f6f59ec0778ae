"""The adapter finds a right auto_LiRPA and keeps the loop away from what it gets wrong."""

import math
from pathlib import Path

import pytest
import torch

from sagemp_cli.errors import UnsupportedOperationError, UsageError
from sagemp_cli.reachability.lirpa import adapter as lirpa_adapter
from sagemp_cli.reachability.lirpa.adapter import Source, bound, find
from sagemp_cli.sets import Box

OWN = Source("0.7.1", Path("own/__init__.py"), "installed")
OLD = Source("0.3", Path("old/__init__.py"), "installed")
CARRIED = Source("0.6.0", Path("carried/__init__.py"), "neuralsat")

needs_library = pytest.mark.skipif(
    lirpa_adapter._installed() is None and lirpa_adapter._carried() is None, reason="no auto_LiRPA is installed"
)


def present(monkeypatch, installed, carried):
    monkeypatch.setattr(lirpa_adapter, "_installed", lambda: installed)
    monkeypatch.setattr(lirpa_adapter, "_carried", lambda: carried)


def test_the_users_own_release_comes_first(monkeypatch):
    present(monkeypatch, OWN, CARRIED)
    assert find() is OWN


def test_the_carried_release_stands_in_for_a_missing_or_old_one(monkeypatch):
    present(monkeypatch, None, CARRIED)
    assert find() is CARRIED
    present(monkeypatch, OLD, CARRIED)
    assert find() is CARRIED


def test_an_old_release_is_refused_with_the_reason_and_the_cure(monkeypatch):
    present(monkeypatch, OLD, None)
    with pytest.raises(UsageError, match=r"auto_LiRPA 0\.3 is refused.*division wrongly.*pip install --no-deps neural"):
        find()


def test_a_missing_library_is_reported_with_the_install_command(monkeypatch):
    present(monkeypatch, None, None)
    with pytest.raises(UsageError, match=r"auto_LiRPA is not installed; install one with: pip install --no-deps"):
        find()


def test_the_version_is_read_without_importing(tmp_path):
    init = tmp_path / "__init__.py"
    init.write_text("raise SystemExit\n__version__ = '0.10.2'\n")
    assert lirpa_adapter._version(init) == "0.10.2"
    assert lirpa_adapter._recent("0.10.2") and not lirpa_adapter._recent("0.5.9")


def intervals(low: float, high: float, width: float, count: int = 1500) -> Box:
    generator = torch.Generator().manual_seed(5)
    left = low + (high - low) * torch.rand(count, 1, dtype=torch.float64, generator=generator)
    return Box(left, left + width * torch.rand(count, 1, dtype=torch.float64, generator=generator))


def excess(function, box: Box, enclosure) -> float:
    """How far the function leaves its bounds, over a grid on every interval (<= 0: it does not)."""
    grid = box.lower + box.width * torch.linspace(0, 1, 201, dtype=torch.float64)
    values = function(grid[..., None])[..., 0]
    return float(torch.maximum(values - enclosure.upper, enclosure.lower - values).max())


def tilted(function, slope):
    """A slanted term makes the lines of the relaxation matter, not only its least and largest values."""
    return lambda x: function(x) + slope * x


@needs_library
@pytest.mark.parametrize("function", [torch.sin, torch.cos], ids=["sin", "cos"])
@pytest.mark.parametrize("width", [1e-9, 0.5, 2.0, 2.5, 4.0, 10.0])
def test_sine_and_cosine_enclose_on_intervals_of_any_width(function, width):
    box = intervals(-9.0, 9.0, width)
    for slope in (-2.0, -0.9, -0.4, 0.0, 0.4, 0.9, 2.0):
        assert excess(tilted(function, slope), box, bound(tilted(function, slope), [box])) < 1e-12


@needs_library
def test_the_librarys_own_sine_would_fail_that_test(monkeypatch):
    monkeypatch.setattr(lirpa_adapter, "_operations", dict)
    monkeypatch.setattr(lirpa_adapter, "CHECKED", lirpa_adapter.CHECKED | {"Sin"})
    box = intervals(-9.0, 9.0, 10.0)
    worst = max(excess(tilted(torch.sin, s), box, bound(tilted(torch.sin, s), [box])) for s in (-0.9, 0.0, 0.9))
    assert worst > 1e-3


@needs_library
@pytest.mark.parametrize(
    ("function", "low", "high", "width"),
    [
        (lambda x: x**2, -3.0, 2.0, 1.0),
        (lambda x: x**4, -3.0, 2.0, 1.0),
        (torch.square, -3.0, 2.0, 1.0),
        (torch.tan, -1.5, 0.5, 1.0),
        (lambda x: torch.clamp(x, -0.5, 0.5), -1.0, 0.5, 1.0),
        (lambda x: x.clip(max=0.2), -1.0, 0.5, 1.0),
        (lambda x: torch.clamp_min(x, 0.1), -1.0, 0.5, 1.0),
        (torch.tanh, -4.0, 3.0, 3.0),
        (torch.sigmoid, -4.0, 3.0, 3.0),
        (torch.atan, -4.0, 3.0, 3.0),
        (torch.exp, -2.0, 1.0, 1.0),
        (torch.sqrt, 0.1, 2.0, 1.0),
        (torch.abs, -1.0, 0.5, 1.0),
        (lambda x: 1 / x, 0.1, 2.0, 1.0),
        (lambda x: torch.minimum(x, torch.sin(x)), -2.0, 1.0, 1.0),
        (lambda x: torch.maximum(-x, x), -2.0, 1.0, 1.0),
        (torch.nn.functional.silu, -3.0, 2.0, 2.0),
        (lambda x: torch.nn.functional.leaky_relu(x, 0.1), -1.0, 0.5, 1.0),
    ],
)
def test_checked_and_rewritten_operations_enclose(function, low, high, width):
    box = intervals(low, high, width, count=300)
    for slope in (-1.0, 0.0, 1.0):
        assert excess(tilted(function, slope), box, bound(tilted(function, slope), [box])) < 1e-11


@needs_library
def test_a_clamp_that_saturates_is_bounded_by_its_limits():
    result = bound(lambda x: torch.clamp(x, -0.5, 0.5), [Box(torch.tensor([[1.0]]), torch.tensor([[2.0]]))])
    assert result.lower.item() == result.upper.item() == 0.5


@needs_library
@pytest.mark.parametrize(
    ("function", "words"),
    [
        (torch.nn.functional.elu, "Elu"),
        (torch.nn.functional.softplus, "Softplus"),
        (lambda x: x**1.5, r"torch\.pow with exponent 1\.5"),
        (lambda x: torch.atan2(x, x + 3), "no relaxation for Greater, Less"),
    ],
)
def test_operations_without_a_right_relaxation_are_refused_by_name(function, words):
    with pytest.raises(UnsupportedOperationError, match=words):
        bound(function, [Box(torch.tensor([[1.0]]), torch.tensor([[2.0]]))])


@needs_library
def test_a_denominator_that_may_vanish_makes_its_own_cell_infinite():
    box = Box(torch.tensor([[1.0], [-1.0]]), torch.tensor([[2.0], [1.0]]))
    result = bound(lambda x: 1 / x, [box])
    # The tangent in the middle of [1, 2] gives 4/9 below, the chord 1 above.
    torch.testing.assert_close(result.lower[0], torch.tensor([4 / 9], dtype=torch.float64))
    torch.testing.assert_close(result.upper[0], torch.tensor([1.0], dtype=torch.float64))
    assert result.lower[1].item() == -math.inf and result.upper[1].item() == math.inf


@needs_library
def test_the_callers_settings_are_left_alone(capsys):
    dtype, grad = torch.get_default_dtype(), torch.is_grad_enabled()
    bound(lambda x: torch.minimum(x, -x), [Box(torch.tensor([[1.0]]), torch.tensor([[2.0]]))])
    assert (torch.get_default_dtype(), torch.is_grad_enabled()) == (dtype, grad)
    assert capsys.readouterr() == ("", "")


def test_an_unknown_method_is_refused():
    with pytest.raises(UsageError, match="method must be one of CROWN, IBP, found 'crown'"):
        bound(torch.sin, [], method="crown")
