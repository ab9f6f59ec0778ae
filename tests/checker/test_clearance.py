"""Distances of tubes to walls, obstacles and goals: those of floating point, and none forgotten."""

import math

import numpy as np
import pytest

from sagemp_cli.checker.balls import Unproved
from sagemp_cli.checker.between import Line, boxes_of
from sagemp_cli.checker.clearance import clearances, goal_margins
from sagemp_cli.checker.scene import SafeSet

INF = math.inf
RNG = np.random.default_rng(0)
LOWER = RNG.uniform(-1, 1, size=(2, 3, 2))
UPPER = LOWER + RNG.uniform(0, 0.3, size=LOWER.shape)
"""Two cells' tubes over the position at three samples."""
SCENE = {"workspace": {"lower": [-INF] * 2, "upper": [INF] * 2}, "obstacles": []}


def found(scene):
    safe = SafeSet.of(SCENE | scene)
    boxes = [box for low, high in zip(LOWER, UPPER, strict=True) for box in boxes_of(low, high)]
    return [float(d) for d in clearances(safe, [Line(box, box) for box in boxes], 1)]


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("face", ["lower", "upper"])
@pytest.mark.parametrize("at", [-2.0, 0.1, 3.0])
def test_a_wall_is_as_near_as_the_box_that_is_nearest_or_farthest_beyond(axis, face, at):
    wall = [-INF, -INF] if face == "lower" else [INF, INF]
    wall[axis] = at
    expected = (LOWER[..., axis] - at if face == "lower" else at - UPPER[..., axis]).min()
    assert found({"workspace": SCENE["workspace"] | {face: wall}})[0] == pytest.approx(expected, abs=1e-12)


def test_all_four_walls_count():
    walls = {"lower": [-1.5, -1.3], "upper": [1.4, 1.7]}
    expected = min((LOWER - walls["lower"]).min(), (walls["upper"] - UPPER).min())
    assert found({"workspace": walls})[0] == pytest.approx(expected, abs=1e-12)
    assert found({})[0] == INF


@pytest.mark.parametrize("center", [(2.0, 0.0), (0.0, 0.0), (-1.5, 1.5), (0.2, -3.0)])
def test_a_ball_is_as_far_as_the_nearest_point_of_the_boxes_and_a_block_as_the_largest_gap(center):
    nearest = np.clip(center, LOWER, UPPER)
    ball = {"kind": "ball", "name": "a", "center": list(center), "radius": 0.4}
    distances = np.linalg.norm(nearest - center, axis=-1) - 0.4
    low, high = np.array(center) - [0.3, 0.1], np.array(center) + [0.2, 0.4]
    block = {"kind": "block", "name": "b", "lower": low.tolist(), "upper": high.tolist()}
    gaps = np.maximum(low - UPPER, LOWER - high).max(-1)
    assert found({"obstacles": [ball, block]})[1:] == pytest.approx([distances.min(), gaps.min()], abs=1e-12)


@pytest.mark.parametrize("lower", [-INF, -0.5])
@pytest.mark.parametrize("upper", [INF, 0.4])
def test_a_goal_has_a_margin_for_each_state_that_has_a_face(lower, upper):
    safe = SafeSet.of(SCENE | {"goal": {"lower": [lower, -INF], "upper": [upper, INF]}})
    found, other = goal_margins(safe, np.array([-0.2, -0.2]), np.array([0.3, 0.3]))
    expected = min(-0.2 - lower, upper - 0.3)
    assert other is None and (found is None) == (expected == INF)
    assert found is None or float(found) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("upper", [[1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
def test_a_block_with_one_side_the_wrong_way_round_is_refused(upper):
    block = {"kind": "block", "name": "b", "lower": [0.0, 0.0], "upper": upper}
    with pytest.raises(Unproved, match="corners are the wrong way round"):
        SafeSet.of(SCENE | {"obstacles": [block]})
