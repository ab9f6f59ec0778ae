"""References from waypoints: constant speed, headings of the way, corners as round as asked for and no rounder."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from sagemp_cli.errors import ConfigError
from sagemp_cli.planners.vlm import Drive, reference_of
from sagemp_cli.planners.vlm.waypoints import rounded

PLAIN = Drive(corner_radius=0.0, lead=0.0)
L_SHAPE = np.array([[1.0, 0.0], [1.0, 2.0]])


def reference(places, start=(0.0, 0.0, 0.0), *, drive=PLAIN, horizon=60, dt=0.1):
    return reference_of(
        np.array(places, dtype=float), np.array(start, dtype=float), horizon=horizon, dt=dt, drive=drive
    )


def test_without_rounding_it_is_the_linear_interpolation_at_constant_speed():
    found = reference(L_SHAPE)
    s = 3.0 * np.arange(61) / 60
    np.testing.assert_allclose(found[:, 0], np.minimum(s, 1.0), atol=1e-12)
    np.testing.assert_allclose(found[:, 1], np.maximum(s - 1.0, 0.0), atol=1e-12)
    # Row k's heading is that of the step to row k+1, and the corner is at row 20.
    np.testing.assert_allclose(found[:20, 2], 0.0, atol=1e-12)
    np.testing.assert_allclose(found[20:, 2], math.pi / 2, atol=1e-12)


def test_the_euler_step_of_a_unicycle_goes_along_it():
    found = reference([[1.0, 0.7], [0.3, 1.5], [2.0, 2.0]], (0.0, 0.0, 0.3, 0.8), drive=Drive())
    assert found.shape == (61, 4) and found[0].tolist() == [0.0, 0.0, 0.3, 0.8]
    x, y, theta, v = found[1:-1].T
    np.testing.assert_allclose(found[2:, 0], x + 0.1 * v * np.cos(theta), atol=1e-9)
    np.testing.assert_allclose(found[2:, 1], y + 0.1 * v * np.sin(theta), atol=1e-9)


def test_a_corner_becomes_an_arc_of_the_radius_that_touches_both_lines():
    path = rounded(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0]]), 0.4)
    arc = path[1:-1]
    np.testing.assert_allclose(np.linalg.norm(arc - [0.6, 0.4], axis=1), 0.4, atol=1e-12)
    np.testing.assert_allclose([arc[0], arc[-1]], [[0.6, 0.0], [1.0, 0.4]], atol=1e-12)


def test_an_arc_takes_at_most_half_of_a_piece_between_corners():
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.2], [2.0, 0.2]])
    path = rounded(corners, 5.0)
    assert path[:, 0].min() >= 0 and path[:, 0].max() <= 2
    middle = path[np.abs(path - [1.0, 0.1]).sum(1).argmin()]
    np.testing.assert_allclose(middle, [1.0, 0.1], atol=1e-12)
    assert np.all(np.diff(path[:, 0]) >= -1e-12)  # arcs do not overlap


def test_a_rounded_path_stays_as_near_to_its_corners_as_is_said():
    rng = np.random.default_rng(0)
    for _ in range(50):
        corners = rng.normal(size=(5, 2))
        path, radius = rounded(corners, 0.3), 0.3
        for a, corner, b in zip(corners[:-2], corners[1:-1], corners[2:]):
            u, v = (a - corner) / np.linalg.norm(a - corner), (b - corner) / np.linalg.norm(b - corner)
            turn = math.pi - math.acos(np.clip(u @ v, -1, 1))
            nearest = np.linalg.norm(path - corner, axis=1).min()
            assert nearest <= radius * (1 / math.cos(turn / 2) - 1) + 0.01


def test_rounding_takes_the_jumps_out_of_the_heading():
    sharp = reference(L_SHAPE, horizon=100)
    smooth = reference(L_SHAPE, horizon=100, drive=Drive(corner_radius=0.4, lead=0.0))
    assert np.abs(np.diff(sharp[:, 2])).max() > 1.0
    speed = 0.03  # metres a step
    assert np.abs(np.diff(smooth[:, 2])).max() < 1.2 * speed / 0.4


def test_the_path_leaves_the_start_along_its_heading():
    found = reference([[0.0, 2.0]], drive=Drive(corner_radius=0.2, lead=0.4), horizon=100)
    assert abs(found[1, 2]) < 1e-9 and found[1, 1] == pytest.approx(0.0)
    assert np.abs(np.diff(found[:, 2])).max() < 0.2


def test_headings_do_not_jump_by_a_full_turn():
    square = [[1, 0], [1, 1], [-1, 1], [-1, -1], [1, -1], [1, 0.5]]
    found = reference(square, drive=Drive(corner_radius=0.3, lead=0.0), horizon=200)
    assert np.abs(np.diff(found[:, 2])).max() < 0.5
    assert found[-1, 2] == pytest.approx(2.5 * math.pi)


def test_a_ramp_takes_the_speed_from_the_starts_to_a_constant_one_and_still_arrives():
    found = reference([[6.0, 0.0]], (0, 0, 0, 0.2), drive=Drive(0.0, 0.0, ramp=2.0), horizon=60)
    steps = np.diff(found[:, 0]) / 0.1
    cruise = (6.0 - 0.5 * 2.0 * 0.2) / (6.0 - 1.0)
    np.testing.assert_allclose(steps[20:], cruise)
    assert np.all(np.diff(steps[:20]) > 0) and steps[0] == pytest.approx(0.2, abs=0.05)
    assert found[-1, 0] == pytest.approx(6.0)


@pytest.mark.parametrize("places", [[[0.0, 0.0]], [[0.0, 0.0], [1.0, 0.0], [1.0, 0.0]], [[1.0, 0.0], [0.5, 0.0]]])
def test_repeated_places_and_reversals_give_finite_references(places):
    found = reference(places, (0.0, 0.0, 0.5), drive=Drive())
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[-1, :2], places[-1], atol=1e-9)


def test_whatever_waypoints_an_answer_may_hold_the_reference_is_finite_and_no_wider_than_they_are():
    rng = np.random.default_rng(0)
    for trial in range(100):
        count, scale = rng.integers(1, 101), 10.0 ** rng.uniform(-12, 0)
        places = rng.choice([-1.0, 0.0, 1.0], size=(count, 2)) + scale * rng.normal(size=(count, 2)) * (trial % 3 > 0)
        places[rng.integers(count, size=count // 2)] = places[0]
        start = np.array([*places[-1] * (trial % 2), rng.uniform(-7, 7), 0.1])
        drive = Drive(*10.0 ** rng.uniform(-9, 3, size=3)) if trial % 5 else Drive()
        found = reference_of(places, start, horizon=50, dt=0.1, drive=drive)
        assert found.shape == (51, 4) and np.isfinite(found).all()
        np.testing.assert_array_equal(found[0], start)
        reach = max(abs(places).max(), abs(start[:2]).max())
        assert abs(found[:, :2]).max() <= 1.5 * reach + 1e-6


def test_wrong_options_are_refused():
    with pytest.raises(ConfigError, match=re.escape("must be zero or positive, found -1, 0.2 and 0.0")):
        Drive(corner_radius=-1)
