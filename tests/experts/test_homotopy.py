from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sagemp_cli.experts.homotopy import FREE, guesses, side_directions, sides_of
from sagemp_cli.scenes import Ball, Block, Scene
from sagemp_cli.sets import Box

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


def test_there_is_one_guess_for_each_combination_of_sides_and_it_passes_as_asked(slalom):
    found = guesses(slalom, np.zeros(2), np.array([5.0, 0.0]), horizon=50, margin=0.3, longest_detour=2.0)
    assert {sides for sides, _ in found} == {(0, 0), (0, 1), (1, 0), (1, 1)}
    for sides, path in found:
        assert path.shape == (51, 2)
        np.testing.assert_array_equal(path[[0, -1]], [[0.0, 0.0], [5.0, 0.0]])
        assert sides_of(path, slalom.obstacles) == sides


def test_long_detours_are_left_out_and_the_shortest_guess_comes_first(slalom):
    found = guesses(slalom, np.zeros(2), np.array([5.0, 0.0]), horizon=50, margin=0.3, longest_detour=1.0)
    assert [sides for sides, _ in found] == [(0, 1)]


def test_an_obstacle_behind_the_start_asks_for_no_side(slalom):
    found = guesses(slalom, np.array([2.8, 0.0]), np.array([5.0, 0.0]), horizon=50, margin=0.3, longest_detour=2.0)
    assert {sides for sides, _ in found} == {(FREE, 0), (FREE, 1)}


def test_a_side_without_room_is_left_out(slalom):
    wall = Block((3.0, 0.5), (4.2, 3.0), "wall up to the upper wall")
    scene = replace(slalom, obstacles=(wall,))
    found = guesses(scene, np.zeros(2), np.array([5.0, 0.0]), horizon=50, margin=0.3, longest_detour=3.0)
    assert [sides for sides, _ in found] == [(1,)]


def test_no_guess_is_left_when_every_side_is_blocked(slalom):
    scene = replace(slalom, obstacles=(Block((3.0, -3.0), (4.2, 3.0), "wall"),))
    assert guesses(scene, np.zeros(2), np.array([5.0, 0.0]), horizon=50, margin=0.3) == []


@pytest.mark.parametrize("way", [[1.0, 0.0, 0.0], [1.0, -2.0, 0.5], [0.0, 0.0, 3.0]])
def test_sides_in_space_are_four_directions_square_to_the_way(way):
    directions = side_directions(np.zeros(3), np.array(way))
    np.testing.assert_allclose(directions @ np.array(way), 0.0, atol=1e-12)
    np.testing.assert_allclose(directions @ directions.T, np.kron([[1, -1], [-1, 1]], np.eye(2)), atol=1e-12)


def test_a_sphere_is_passed_left_over_right_and_under():
    far = torch.full((3,), 5.0)
    goal = torch.tensor([4.0, 0.0, 0.0])
    scene = Scene(Box(-far, far), (Ball((2.0, 0.0, 0.0), 0.5),), Box(goal - 0.1, goal + 0.1))
    found = guesses(scene, np.zeros(3), goal.numpy().astype(float), horizon=40, margin=0.2)
    assert sorted(sides for sides, _ in found) == [(0,), (1,), (2,), (3,)]
    middle = {sides[0]: path[20] for sides, path in found}
    assert middle[0][1] > 0.5 and middle[1][2] > 0.5 and middle[2][1] < -0.5 and middle[3][2] < -0.5
    for sides, path in found:
        assert sides_of(path, scene.obstacles) == sides
