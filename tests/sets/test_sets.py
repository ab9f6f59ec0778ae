"""Boxes and tubes against exact arithmetic."""

from __future__ import annotations

from fractions import Fraction

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sagemp_cli.errors import NonFiniteError, UsageError
from sagemp_cli.sets import Box, Tube, round_down, round_up

NUMBERS = st.floats(-1e6, 1e6)


def numbers(values):
    return torch.tensor(values, dtype=torch.float64)


@given(NUMBERS)
def test_rounding_moves_to_the_neighbouring_number(x):
    down, up = float(round_down(numbers(x))), float(round_up(numbers(x)))
    assert down < x < up
    assert float(round_up(numbers(down))) == x or x == 0


@given(center=NUMBERS, radius=st.floats(0, 1e6))
def test_a_box_around_a_point_contains_all_that_it_should(center, radius):
    box = Box.around([center], [radius])
    assert Fraction(float(box.lower)) <= Fraction(center) - Fraction(radius)
    assert Fraction(float(box.upper)) >= Fraction(center) + Fraction(radius)


def test_a_box_of_zero_radius_is_the_point_itself():
    box = Box.around([0.1, 0.2], [0.0, 1.0])
    assert float(box.lower[0]) == float(box.upper[0]) == 0.1


@given(low=NUMBERS, width=st.floats(0, 1e6))
def test_center_and_radius_enclose_the_box(low, width):
    box = Box(numbers([low]), numbers([low + width]))
    center, radius = Fraction(float(box.center)), Fraction(float(box.radius))
    assert box.contains(box.center)
    assert center - radius <= Fraction(float(box.lower))
    assert center + radius >= Fraction(float(box.upper))


@given(
    low=st.tuples(NUMBERS, NUMBERS),
    width=st.tuples(st.floats(0, 100), st.floats(0, 100)),
    counts=st.tuples(st.integers(1, 7), st.integers(1, 7)),
)
def test_a_partition_covers_the_box_without_gaps_or_overhang(low, width, counts):
    box = Box(numbers(low), numbers(low) + numbers(width))
    cells = box.split(counts)
    assert cells.lower.shape == (counts[0] * counts[1], 2)
    assert torch.equal(cells.hull().lower, box.lower)
    assert torch.equal(cells.hull().upper, box.upper)
    for d in range(2):
        faces = sorted(set(zip(cells.lower[:, d].tolist(), cells.upper[:, d].tolist(), strict=True)))
        reached = faces[0][0]
        for a, b in faces:
            assert a <= reached
            reached = max(reached, b)
        assert reached == float(box.upper[d])


@pytest.mark.parametrize("counts", [[2], [2, 0], [2, 2, 2]])
def test_a_partition_needs_one_positive_count_per_dimension(counts):
    with pytest.raises(UsageError, match=r"partition counts must be 2 positive integers, found \["):
        Box.around([0.0, 0.0], [1.0, 1.0]).split(counts)


def test_only_a_single_box_is_split():
    with pytest.raises(UsageError, match="only a single box can be split"):
        Box(torch.zeros(3, 2), torch.ones(3, 2)).split([1, 1])


def test_samples_lie_in_the_box_and_repeat_with_the_generator():
    box = Box.around([1.0, -2.0], [0.5, 0.0])
    first = box.sample(500, torch.Generator().manual_seed(3))
    assert bool(box.contains(first).all())
    assert torch.equal(first, box.sample(500, torch.Generator().manual_seed(3)))
    assert float(first[:, 0].max() - first[:, 0].min()) > 0.9


def test_containment_is_exact_at_the_faces():
    box = Box(numbers([0.0]), numbers([1.0]))
    assert bool(box.contains(numbers([1.0])))
    assert not bool(box.contains(round_up(numbers([1.0]))))
    assert bool(box.contains(box))
    assert not bool(box.contains(Box(numbers([-1e-300]), numbers([1.0]))))


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: Box(numbers([1.0, 3.0]), numbers([2.0, 2.0])), UsageError, "negative width in dimension 1"),
        (lambda: Box(numbers([float("nan")]), numbers([1.0])), NonFiniteError, "box corner is NaN"),
        (lambda: Box(numbers([0.0]), numbers([1.0, 2.0])), UsageError, r"differ in shape: \(1,\) and \(2,\)"),
        (lambda: Box.around([0.0], [-1.0]), UsageError, r"radius must be finite and not negative, found \[-1.0\]"),
        (lambda: Box.around([float("inf")], [1.0]), NonFiniteError, "box center must be finite"),
    ],
)
def test_what_is_no_box_is_refused(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_a_tube_holds_the_rollouts_that_never_leave_it():
    tube = Tube(torch.zeros(4, 2, dtype=torch.float64), torch.ones(4, 2, dtype=torch.float64))
    inside = torch.full((4, 2), 0.5, dtype=torch.float64)
    outside = inside.clone()
    outside[3, 1] = 1.5
    assert tube.contains(torch.stack([inside, outside])).tolist() == [True, False]
    assert tube.horizon == 3
    assert torch.equal(tube.width, torch.ones(4, 2, dtype=torch.float64))


@pytest.mark.parametrize("bad", [float("inf"), float("nan")])
def test_a_tube_with_an_infinite_or_undefined_bound_is_not_bounded(bad):
    upper = torch.ones(2, 3, 1, dtype=torch.float64)
    upper[1, 2, 0] = bad
    assert Tube(torch.zeros_like(upper), upper).bounded.tolist() == [True, False]


def test_the_hull_of_tubes_contains_them_all():
    lower = torch.tensor([[[0.0], [2.0]], [[-1.0], [3.0]]], dtype=torch.float64)
    hull = Tube(lower, lower + 1).hull()
    assert hull.lower.tolist() == [[-1.0], [2.0]]
    assert hull.upper.tolist() == [[1.0], [4.0]]
