from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from sagemp_cli.experts.homotopy import FREE, guesses
from sagemp_cli.scenes import Ball, Block, Scene
from sagemp_cli.scenes.sides import sides_of
from sagemp_cli.sets import Box


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
