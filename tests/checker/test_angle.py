"""The angle of a point less a multiple of its distance across a direction: bounded at every point of its box."""

import math

import numpy as np
import pytest
from flint import arb, ctx

from sagemp_cli.checker.angle import Turned, angle_excess

# y and x, and the direction: right, up, left above and below the jump, across it, and around the origin.
BOXES = {
    "right": ((-0.4, 0.5), (1.0, 1.5), (1.0, 0.1)),
    "right, another direction": ((-0.4, 0.5), (1.0, 1.5), (0.3, 1.0)),
    "above": ((0.5, 0.9), (-0.7, 0.4), (0.0, 1.0)),
    "below": ((-2.0, -0.5), (-0.7, 0.4), (0.2, -1.0)),
    "left above the jump": ((0.1, 0.4), (-2.0, -1.0), (-1.0, 0.2)),
    "left below the jump": ((-0.4, -0.1), (-2.0, -1.0), (-1.0, -0.2)),
    "left, the direction on the other side of the jump": ((0.1, 0.4), (-2.0, -1.0), (-1.0, -0.2)),
    "across the jump, the direction above": ((-0.4, 0.3), (-2.0, -1.0), (-1.0, 0.1)),
    "across the jump, the direction below": ((-0.4, 0.3), (-2.0, -1.0), (-1.0, -0.1)),
    "around the origin": ((-0.4, 0.3), (-0.2, 0.5), (1.0, 0.0)),
    "a point": ((0.3, 0.3), (0.8, 0.8), (0.8, 0.3)),
}


def turned(y, x, cosine, sine):
    """The box's points along and across a direction, its sides taken as independent."""

    def sides(of_x, of_y):
        ends = [[of_x * a for a in x], [of_y * b for b in y]]
        return sum(map(min, ends)), sum(map(max, ends))

    across, along = sides(-sine, cosine), sides(cosine, sine)
    scale = math.sqrt((along[1] - along[0]) / (across[1] - across[0])) if across[1] > across[0] else 1.0
    most = scale * 0.5 * (across[1] - across[0]) + 0.5 * (along[1] - along[0]) / scale + 1e-9
    out = [(arb(low - 1e-12), arb(high + 1e-12)) for low, high in (across, along)]
    middles = [arb(0.5 * (low + high)) for low, high in (across, along)]
    return Turned(arb(cosine), arb(sine), *out, *middles, arb(most), arb(most))


@pytest.mark.parametrize("name", BOXES)
@pytest.mark.parametrize("slope", [-1.1, 0.0, 0.4, 0.8, 2.5])
def test_no_point_of_the_box_is_outside(name, slope):
    y, x, direction = BOXES[name]
    cosine, sine = np.array(direction) / np.hypot(*direction)
    with ctx.workprec(128):
        least, most = angle_excess(
            arb(slope), tuple(map(arb, y)), tuple(map(arb, x)), turned(y, x, float(cosine), float(sine))
        )
    b, a = np.meshgrid(np.linspace(*y, 61), np.linspace(*x, 61))
    excess = np.arctan2(b, a) - slope * (cosine * b - sine * a)
    assert float(least) <= excess.min() + 1e-9 and excess.max() - 1e-9 <= float(most)
    assert math.isfinite(float(least)) and math.isfinite(float(most))


def test_near_its_own_slope_an_angle_is_nearly_a_line_across_its_direction():
    y, x, _ = BOXES["right"]
    middle = 0.8
    with ctx.workprec(128):
        least, most = angle_excess(arb(middle), tuple(map(arb, y)), tuple(map(arb, x)), turned(y, x, 1.0, 0.0))
    assert float(most - least) < 0.2
