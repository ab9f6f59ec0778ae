"""Rollouts in balls, from numbers as they are stored."""

from fractions import Fraction

import numpy as np

from sagemp_cli.checker.balls import balls
from sagemp_cli.checker.counterexample import _moved, replay

from .by_hand import line, program

THIRD = program(
    line("constant", constants=[1 / 3]), line("mul", 2, 0), line("linear", 1, constants=[1, -1, 0, 0]),
    line("add", 3, 4), next=5,
)  # fmt: skip
"""``x' = (1/3 in float64) x + (w, -w)``."""


def test_a_replay_holds_the_rollout_of_exact_numbers():
    start, disturbances = [0.1, -0.7], [[0.25], [0.1], [-0.3]]
    states = replay([THIRD] * 3, start, disturbances, np.zeros((3, 0)))
    exact = [Fraction(v) for v in start]
    for k, x in enumerate(states):
        for ball, value in zip(x, exact, strict=True):
            assert float(ball.rad()) < 1e-30 and abs(float(ball.mid()) - float(value)) < 1e-15
        if k < 3:
            w = Fraction(disturbances[k][0])
            exact = [Fraction(1 / 3) * exact[0] + w, Fraction(1 / 3) * exact[1] - w]


def test_what_lies_outside_of_a_set_is_moved_to_its_nearest_point_and_what_lies_inside_stays():
    box = list(zip(balls([-1.0, 0.5]), balls([1.0, 0.5]), strict=True))
    for point, nearest in [((0.25, 0.5), (0.25, 0.5)), ((-1.5, 0.4), (-1.0, 0.5)), ((7.0, 0.6), (1.0, 0.5))]:
        assert [float(v) for v in _moved(np.array(point), box)] == list(nearest)
