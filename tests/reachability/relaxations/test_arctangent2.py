"""The angle of a point: bands and lines against ball arithmetic, wherever the box lies, and exactly as wide as it must.

A point (across, along) of a turned box is what the relaxation is of; its true angle is computed in ball arithmetic.
"""

import math

import flint
import pytest
import torch
from flint import arb

from sagemp_cli.reachability.relaxations import arctangent2

GRID = torch.linspace(0.0, 1.0, 9, dtype=torch.float64)


def boxes(count: int, seed: int) -> tuple[torch.Tensor, ...]:
    """Centres and half-widths of boxes: tiny and huge, in all directions, some with the origin or the jump inside."""
    generator = torch.Generator().manual_seed(seed)
    angle = 2 * math.pi * torch.rand(count, dtype=torch.float64, generator=generator)
    distance = 10.0 ** (8 * torch.rand(count, dtype=torch.float64, generator=generator) - 4)
    shares = 10.0 ** (6.5 * torch.rand(2, count, dtype=torch.float64, generator=generator) - 6)
    center = torch.stack([torch.sin(angle), torch.cos(angle)]) * distance
    center[:, ::7] = center[:, ::7].round()  # on the axes, where one of them is rounded to 0
    return center[0], center[1], shares[0] * distance, shares[1] * distance


def relaxed(y, x, ry, rx):
    """Band and lines of independent operands, and the direction."""
    low, high = arctangent2.value_range(y - ry, y + ry, x - rx, x + rx)
    turn = arctangent2.turn(low, high)
    c, s = turn.cosine, turn.sine
    center = torch.stack([c * y - s * x, c * x + s * y])
    radius = torch.stack([c.abs() * ry + s.abs() * rx, c.abs() * rx + s.abs() * ry])
    radius = radius * (1 + 1e-14) + (y.abs() + x.abs()) * 1e-15
    v, u = zip(center - radius, center + radius, strict=True)
    twice = 2 * radius[0] * radius[1]
    twist = arctangent2.twist(center[0], radius[1], (2 * twice).sqrt(), (2 * twice).sqrt())
    given = (*u, center[1], *twist, turn.angle, low, high)
    return arctangent2.band(*v, *given), arctangent2.lines(*v, *given), turn


def angle_of(y: arb, x: arb) -> arb:
    return arb.atan2(y, x)


@pytest.mark.parametrize("seed", range(3))
def test_bands_and_lines_contain_the_angle(seed):
    y, x, ry, rx = boxes(120, seed)
    band, lines, turn = relaxed(y, x, ry, rx)
    claims = 0
    before, flint.ctx.prec = flint.ctx.prec, 150
    try:
        for i in range(len(y)):
            slope, offset, radius = (arb(float(part[i])) for part in band)
            claims += float(band.radius[i]) < 1.0
            c, s = arb(float(turn.cosine[i])), arb(float(turn.sine[i]))
            a, b, p, q = (arb(float(part[i])) for part in lines)
            for f in GRID.tolist():
                for g in GRID.tolist():
                    yy = arb(float(y[i])) + arb(float(ry[i])) * arb(2 * f - 1)
                    xx = arb(float(x[i])) + arb(float(rx[i])) * arb(2 * g - 1)
                    if yy == 0 and xx <= 0:
                        continue
                    angle, across = angle_of(yy, xx), c * yy - s * xx
                    assert abs(angle - slope * across - offset) <= radius
                    assert a * across + b <= angle <= p * across + q
    finally:
        flint.ctx.prec = before
    assert claims > 80


def test_the_band_of_a_small_box_is_as_wide_as_the_angle_bends():
    # Turned, the box is 0.6 + 0.8 times as large in both directions, and what no line has is the product of both.
    for size in (1e-1, 1e-2, 1e-3):
        one = torch.ones(1, dtype=torch.float64)
        band, _, _ = relaxed(0.6 * one, 0.8 * one, size * one, size * one)
        assert float(band.radius) < 1.4**2 * size**2 * (1.0 + 3 * size)


def test_lines_lie_within_the_band_where_it_matters():
    y, x, ry, rx = boxes(400, 5)
    band, lines, turn = relaxed(y, x, ry, rx)
    middle = turn.cosine * y - turn.sine * x
    above = lines.upper_slope * middle + lines.upper_offset
    below = lines.lower_slope * middle + lines.lower_offset
    assert bool((above - below <= 2 * band.radius * (1 + 1e-9) + 1e-13).all())


def test_a_point_and_an_infinite_box():
    one = torch.ones(1, dtype=torch.float64)
    band, _, _ = relaxed(-2.0 * one, 0.3 * one, 0 * one, 0 * one)
    assert float(band.radius) < 1e-13
    band, _, _ = relaxed(one, one, math.inf * one, one)
    assert math.pi <= float(band.radius) < 3.2 and float(band.slope) == 0


@pytest.mark.parametrize("middle", [-2.0, 0.0, 2.0])
@pytest.mark.parametrize("scale", [0.3, 1.0, 2.0])
def test_the_product_of_what_is_across_and_what_is_along_is_between_its_bounds(middle, scale):
    """X within 0.5 and Y within 0.3, independent of one another."""
    most = torch.tensor(scale * 0.5 + 0.3 / scale, dtype=torch.float64)
    v, radius = torch.tensor(middle, dtype=torch.float64), torch.tensor(0.3, dtype=torch.float64)
    low, high = arctangent2.twist(v, radius, most, most)
    exact = (abs(middle) + 0.5) * 0.3
    assert float(low) <= -exact and exact <= float(high)
    assert float(high - low) <= 2 * (abs(middle) * 0.3 + 0.25 * float(most) ** 2) + 1e-12
