"""The angle of a point, ``atan2(y, x)``: one function of two operands, whatever their bounds.

Turned by any direction (c, s) the point is ``v = c y - s x`` across it and ``u = c x + s y`` along it, and where u is
positive its angle is that of the direction plus ``atan(v / u)``, up to whole turns. For a fixed v this is monotone in
u, so it is extreme at the ends of u, where it is an arc tangent of v alone: two bounds of one variable serve. The
direction is in the middle of the angles of the box of x and y, where the angle hardly depends on u. Any direction is
sound; it is not seen outside, where the operation is one function of y and x.

Where that says nothing, because the box meets the origin or the jump (the negative x axis) or is so large that a line
is worse than none, the angle is between the bounds of the box's angles, the whole circle if need be.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations import arctangent, pieces
from sagemp_cli.reachability.relaxations import lines as _lines
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.reachability.relaxations.pieces import Excess
from sagemp_cli.sets.rounding import TINY, gamma, slack

WHOLE = math.pi * (1.0 + 2.0**-50)
"""Bound of all angles."""

_BETTER = 0.99
"""A band is taken for another one if it has less than this of its radius; less than that hangs on rounding."""

_ALONE = 4.7
"""An angle this far from a direction's, and one at most pi/2 from it, of the same point, are no turn apart."""


class Turn(NamedTuple):
    """A direction: cosine and sine, numbers that need not be of length 1, and its angle up to rounding."""

    cosine: Tensor
    sine: Tensor
    angle: Tensor


class Along(NamedTuple):
    """What is known of a point beside how far it is across a direction.

    Attributes:
        least, most: of how far it is along the direction, u.
        middle: any number, best in the middle of u.
        twist_low, twist_high: of ``v (u - middle)``; not positive and not negative.
        angle: of the direction.
        low, high: of the point's angle.
    """

    least: Tensor
    most: Tensor
    middle: Tensor
    twist_low: Tensor
    twist_high: Tensor
    angle: Tensor
    low: Tensor
    high: Tensor


@torch.no_grad()
def turn(low: Tensor, high: Tensor) -> Turn:
    """The direction in the middle of angles between two bounds."""
    middle = 0.5 * low + 0.5 * high
    cosine, sine = torch.cos(middle), torch.sin(middle)
    return Turn(cosine, sine, torch.atan2(sine, cosine))


def band(lower: Tensor, upper: Tensor, *along: Tensor) -> Band:
    """Band of the angle as a function of v on ``[lower, upper]``; the others are those of :class:`Along`."""
    known = Along(*along)
    best = _level(known)
    for slope in (_chord(lower, upper, known).detach(), _best(lower, upper, known, pieces.radius_objective)):
        found = _excess(slope, lower, upper, known)
        radius = 0.5 * (found.most - found.least) + slack(abs(found.most) + abs(found.least), 2)
        offset = 0.5 * (found.most + found.least)
        better = torch.isfinite(slope) & (radius < _BETTER * best.radius)  # no number is not better
        best = Band(*(torch.where(better, *pair) for pair in zip((slope, offset, radius), best, strict=True)))
    return best


def lines(lower: Tensor, upper: Tensor, *along: Tensor) -> Lines:
    """Lines of the angle as a function of v on ``[lower, upper]``; the others are those of :class:`Along`."""
    known = Along(*along)
    best, middle = _lines.parallel(_level(known)), 0.5 * lower + 0.5 * upper
    objectives = (pieces.radius_objective, pieces.upper_objective, pieces.lower_objective)
    slopes = [_best(lower, upper, known, objective) for objective in objectives]
    for slope in (_chord(lower, upper, known), *slopes):
        found = _excess(slope, lower, upper, known)
        best = _lines.choose(best, Lines(slope, found.least, slope, found.most), middle)
    return _lines.settled(best)


def value_range(y_lower: Tensor, y_upper: Tensor, x_lower: Tensor, x_upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds over a box: those at its corners, plus 8 ulps of pi; the whole circle if it meets the jump."""
    corners = torch.stack([torch.atan2(y, x) for y in (y_lower, y_upper) for x in (x_lower, x_upper)])
    known = ((x_lower > 0) | (y_lower > 0) | (y_upper < 0)) & torch.isfinite(corners).all(0)
    margin = 8 * math.pi * 2.0**-52
    low, high = corners.amin(0) - margin, corners.amax(0) + margin
    return torch.where(known, low, torch.full_like(low, -WHOLE)), torch.where(known, high, torch.full_like(high, WHOLE))


def twist(v: Tensor, radius: Tensor, plus: Tensor, minus: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of ``V U`` where V is v plus X and U is Y, ``|Y| <= radius``: ``X Y = (P^2 - M^2) / 4``.

    Args:
        v: the middle of V.
        radius: of Y.
        plus, minus: bounds of ``|P|`` and ``|M|`` for ``P = l X + Y / l`` and ``M = l X - Y / l``, for any l > 0.
    """
    shift = abs(v) * radius
    growth = 1.0 + gamma(8)
    return -(0.25 * minus * minus + shift) * growth - TINY, (0.25 * plus * plus + shift) * growth + TINY


def _level(known: Along) -> Band:
    """The band that has no slope."""
    zero = torch.zeros_like(known.low)
    return Band(zero, 0.5 * (known.low + known.high), 0.5 * (known.high - known.low) + slack(math.pi, 8))


@torch.no_grad()
def _best(lower: Tensor, upper: Tensor, known: Along, objective: pieces.Objective) -> Tensor:
    """The slope that makes the objective smallest."""
    ends = torch.stack([lower, upper])
    values = (torch.atan(ends / known.least) + torch.atan(ends / known.most)) * 0.5
    return pieces.best_slope(
        lambda slope: _excess(slope, lower, upper, known),
        lower,
        upper,
        values=(values[0], values[1]),
        objective=objective,
    )


def _chord(lower: Tensor, upper: Tensor, known: Along) -> Tensor:
    """The mean slope of the chords at both ends of u, or where they are rounding only, of the tangents at 0."""
    width = upper - lower
    wide = width > 1e-6 * (lower.abs() + upper.abs()) + TINY
    rise = sum(torch.atan(upper / u) - torch.atan(lower / u) for u in (known.least, known.most))
    return 0.5 * torch.where(wide, rise / torch.where(wide, width, 1.0), 1.0 / known.least + 1.0 / known.most)


def _excess(slope: Tensor, lower: Tensor, upper: Tensor, known: Along) -> Excess:
    """Bounds of ``angle - slope v``, rounding included; infinite or no numbers where nothing is known."""
    least, most = known.least, known.most
    low, high = _at_end(slope, lower, upper, least), _at_end(slope, lower, upper, most)
    either = _joined(low, high)
    twisted = _twisted(slope, lower, upper, known)
    down, up = twisted.least > either.least, twisted.most < either.most
    found = Excess(
        torch.where(down, twisted.least, either.least),
        torch.where(up, twisted.most, either.most),
        torch.where(down, twisted.lowest, either.lowest),
        torch.where(up, twisted.highest, either.highest),
    )
    angle, nothing = known.angle, torch.full_like(slope, math.inf)
    holds = (least > 0) & (angle - known.low < _ALONE) & (known.high - angle < _ALONE)
    holds = holds & torch.isfinite(most) & torch.isfinite(slope)
    doubt = slack(angle.abs() + found.least.abs() + found.most.abs() + 1.0, 16)
    least, most = found.least + angle - doubt, found.most + angle + doubt
    return found._replace(least=torch.where(holds, least, -nothing), most=torch.where(holds, most, nothing))


def _at_end(slope: Tensor, lower: Tensor, upper: Tensor, u: Tensor) -> Excess:
    """Bounds of ``atan(v / u) - slope v`` for that u: of ``atan(t) - (slope u) t`` with ``t = v / u``.

    The ends of t are rounded outwards, and what ``slope u`` as computed is off by is paid for.
    """
    ends = torch.stack([lower / u, upper / u])
    margin = slack(ends.abs(), 2) + TINY
    ends = torch.stack([ends[0] - margin[0], ends[1] + margin[1]])
    steep = slope * u
    found = pieces.excess(arctangent.CURVE, steep, ends, torch.atan(ends))
    doubt = slack(steep.abs() * ends.abs().amax(0) + 1.0, 4)
    return Excess(found.least - doubt, found.most + doubt, found.lowest * u, found.highest * u)


def _twisted(slope: Tensor, lower: Tensor, upper: Tensor, known: Along) -> Excess:
    """Bounds of ``atan(v / u) - slope v`` that use how v and u hang together.

    With the middle c of u, ``v / c = t + v (u - c) / (c u)`` for ``t = v / u``: the excess is that of ``atan(t)`` over
    ``(slope c) t``, less what the last term makes of the slope.
    """
    u = torch.stack([known.least, known.most])
    ends = torch.stack([(lower / u).amin(0), (upper / u).amax(0)])
    margin = slack(ends.abs(), 2) + TINY
    ends = torch.stack([ends[0] - margin[0], ends[1] + margin[1]])
    steep = slope * known.middle
    found = pieces.excess(arctangent.CURVE, steep, ends, torch.atan(ends))
    share = slope.abs() / known.least * (1.0 + gamma(16))
    twists = torch.stack([known.twist_low * share, known.twist_high * share])
    twists = torch.where(slope >= 0, twists, -twists.flip(0))
    doubt = slack(steep.abs() * (ends.abs().amax(0) + 1.0) + 1.0, 8)
    middle = known.middle
    return Excess(
        found.least - twists[1] - doubt, found.most - twists[0] + doubt, found.lowest * middle, found.highest * middle
    )


def _joined(a: Excess, b: Excess) -> Excess:
    """What holds of both."""
    low, high = b.least < a.least, b.most > a.most
    return Excess(
        torch.minimum(a.least, b.least),
        torch.maximum(a.most, b.most),
        torch.where(low, b.lowest, a.lowest),
        torch.where(high, b.highest, a.highest),
    )
