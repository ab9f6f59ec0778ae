"""Trees of boxes against obstacles: the same answers as the full test, and none that is clear but should not be."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sagemp_cli.scenes.scene import Ball, Block, Scene
from sagemp_cli.sets import Box
from sagemp_cli.verification.bounding_volumes import BoundingVolumes


def boxes(rng, tubes, parts, dimension, size):
    """Boxes along random walks, ``(tubes, parts, dimension)``."""
    center = torch.from_numpy(rng.normal(size=(tubes, parts, dimension)).cumsum(1) * size)
    return Box(center - size, center + size)


def scene(obstacles, dimension, workspace=1e6):
    everywhere = torch.full((dimension,), workspace, dtype=torch.float64)
    return Scene(Box(-everywhere, everywhere), tuple(obstacles), Box(-everywhere, everywhere))


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("parts", [1, 7, 8, 65, 200])
def test_the_answers_are_those_of_the_full_test(parts, dimension):
    rng = np.random.default_rng(parts + dimension)
    over = boxes(rng, 40, parts, dimension, 0.1)
    volumes = BoundingVolumes.of(over)
    seen = set()
    for _ in range(20):
        balls = [Ball(tuple(2 * rng.normal(size=dimension)), float(r)) for r in rng.uniform(0.01, 0.6, 3)]
        lows = 2 * rng.normal(size=(3, dimension))
        blocks = [
            Block(tuple(a), tuple(a + b)) for a, b in zip(lows, rng.uniform(0.01, 0.8, (3, dimension)), strict=True)
        ]
        there = scene([*balls, *blocks], dimension, workspace=float(rng.uniform(0.5, 8)))
        expected = (there.clearances(over) > 0).flatten(1).all(1).tolist()
        assert volumes.clear(there).tolist() == expected
        seen |= set(expected)
    assert seen == {True, False}


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.floats(-4, 4), min_size=2, max_size=2),
    st.floats(1e-6, 3),
    st.floats(0, 2 * math.pi),
    st.integers(-40, 40),
)
def test_a_point_called_clear_of_a_ball_is_outside_in_exact_arithmetic(center, radius, angle, ulps):
    """Points within some roundings of the surface."""
    near = [c + radius * f(angle) for c, f in zip(center, (math.cos, math.sin), strict=True)]
    place = [v + ulps * math.ulp(v) for v in near]
    point = torch.tensor([[place]], dtype=torch.float64)
    clear = BoundingVolumes.of(Box(point, point)).clear(scene([Ball(tuple(center), radius)], 2))[0]
    distance = sum((Fraction(p) - Fraction(c)) ** 2 for p, c in zip(place, center, strict=True))
    assert not clear or distance > Fraction(radius) ** 2


@pytest.mark.parametrize("radius", [1e-200, 5e-324])
def test_a_ball_whose_square_underflows_is_not_driven_through(radius):
    point = torch.tensor([[[radius, 0.0]]], dtype=torch.float64)
    assert not BoundingVolumes.of(Box(point, point)).clear(scene([Ball((0.0, 0.0), radius)], 2))[0]


def test_what_is_not_bounded_is_not_clear():
    low, high = torch.zeros(1, 9, 2, dtype=torch.float64), torch.ones(1, 9, 2, dtype=torch.float64)
    above = scene([Ball((0.5, 5.0), 1.0)], 2, workspace=math.inf)
    assert BoundingVolumes.of(Box(low, high)).clear(above)[0]
    high[0, 3, 1] = math.inf
    assert not BoundingVolumes.of(Box(low, high)).clear(above)[0]
    assert not BoundingVolumes.of(Box(low, high)).clear(scene([], 2))[0]


def test_touching_is_not_clear():
    low, high = torch.zeros(1, 1, 2, dtype=torch.float64), torch.ones(1, 1, 2, dtype=torch.float64)
    volumes = BoundingVolumes.of(Box(low, high))
    assert not volumes.clear(scene([Block((1.0, 0.0), (2.0, 1.0))], 2))[0]
    assert volumes.clear(scene([Block((math.nextafter(1.0, 2), 0.0), (2.0, 1.0))], 2))[0]
    assert not volumes.clear(scene([Ball((2.0, 0.5), 1.0)], 2))[0]
    assert volumes.clear(scene([Ball((2.0, 0.5), 1.0 - 1e-12)], 2))[0]


def test_a_block_without_an_end_is_seen_from_empty_padding_as_nothing():
    low, high = torch.zeros(1, 9, 2, dtype=torch.float64), torch.ones(1, 9, 2, dtype=torch.float64)
    volumes = BoundingVolumes.of(Box(low, high))
    assert volumes.clear(scene([Block((-math.inf, 2.0), (math.inf, math.inf))], 2))[0]
    assert not volumes.clear(scene([Block((-math.inf, 0.5), (math.inf, math.inf))], 2))[0]
