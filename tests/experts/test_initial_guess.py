from __future__ import annotations

import numpy as np

from sagemp_cli.experts.initial_guess import fill_path


def test_a_unicycle_on_a_circle_gets_its_heading_speed_and_turn_rate(unicycle):
    angle = np.linspace(0.0, 1.0, 21)  # radius 2 m, 4 s: 0.5 m/s, 0.25 rad/s
    path = 2.0 * np.stack([np.sin(angle), 1.0 - np.cos(angle)], axis=1)
    nodes = fill_path(unicycle, path, start=np.array([0.0, 0.0, 0.0, 0.5]), goal=np.array([1.7, 0.9, np.nan, np.nan]))
    np.testing.assert_allclose(nodes[1:-1, 2], angle[1:-1], atol=0.02)
    np.testing.assert_allclose(nodes[1:-1, 3], 0.5, atol=0.01)
    np.testing.assert_allclose(nodes[2:-2, 4], 0.25, atol=0.02)


def test_a_point_mass_gets_its_velocity_and_acceleration(point_mass):
    time = 0.1 * np.arange(21)[:, None]
    path = 0.5 * time**2 * np.array([1.0, -0.5, 0.25])
    nodes = fill_path(point_mass, path, start=np.zeros(6), goal=np.full(6, np.nan))
    np.testing.assert_allclose(nodes[1:-1, 3:6], time[1:-1] * np.array([1.0, -0.5, 0.25]), atol=0.01)
    np.testing.assert_allclose(nodes[2:-3, 6:], np.tile([1.0, -0.5, 0.25], (16, 1)), atol=0.02)


def test_the_guess_starts_at_the_start_and_keeps_the_limits(unicycle):
    path = np.linspace([0.0, 0.0], [50.0, 0.0], 11)  # 50 m/s is far beyond the speed limit
    start = np.array([0.1, 0.0, 0.2, 1.0])
    nodes = fill_path(unicycle, path, start=start, goal=np.array([50.0, 0.0, 0.0, 1.0]))
    np.testing.assert_array_equal(nodes[0, :4], start)
    assert nodes[1:, 3].max() <= 3.0 and np.abs(nodes[:, 5]).max() <= 2.0
