"""On which side a path passes an obstacle."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sagemp_cli.scenes import Ball, Block
from sagemp_cli.scenes.sides import side_directions, side_label, sides_of

DISC = Ball((2.0, 0.0), 0.5)


def arch(height: float) -> np.ndarray:
    along = np.linspace(0.0, 4.0, 41)
    return np.stack([along, height * np.sin(np.pi * along / 4.0)], axis=1)


def test_passing_above_a_disc_on_the_way_right_is_the_left_side():
    assert sides_of(arch(1.0), [DISC]) == (0,)
    assert sides_of(arch(-1.0), [DISC]) == (1,)
    assert sides_of(arch(1.0)[::-1], [DISC]) == (1,)


@settings(max_examples=30, deadline=None)
@given(angle=st.floats(-3.0, 3.0), wiggle=st.floats(0.0, 0.4), sign=st.sampled_from([-1.0, 1.0]))
def test_the_side_survives_rotations_and_wiggles_that_do_not_cross_the_middle(angle, wiggle, sign):
    path = arch(sign * 1.0)
    path[:, 1] += sign * wiggle * np.sin(np.linspace(0.0, np.pi, 41)) * np.sin(7.0 * path[:, 0]) ** 2
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    middle = turn @ np.array(DISC.center)
    assert sides_of(path @ turn.T, [Ball(tuple(middle), 0.5)]) == (0 if sign > 0 else 1,)


@pytest.mark.parametrize("way", [[1.0, 0.0, 0.0], [1.0, -2.0, 0.5], [0.0, 0.0, 3.0]])
def test_sides_in_space_are_four_directions_square_to_the_way(way):
    directions = side_directions(np.zeros(3), np.array(way))
    np.testing.assert_allclose(directions @ np.array(way), 0.0, atol=1e-12)
    np.testing.assert_allclose(directions @ directions.T, np.kron([[1, -1], [-1, 1]], np.eye(2)), atol=1e-12)


def test_a_block_is_passed_beside_its_middle():
    assert sides_of(arch(1.0), [Block((1.5, -0.5), (2.5, 0.5)), DISC]) == (0, 0)


def test_sides_are_written_as_one_letter_for_each_obstacle():
    assert side_label((0, 1), 2) == "LR" and side_label((0, 1, 2, 3), 3) == "LORU" and side_label((), 2) == ""
