"""How far the angle of a point lies from a line of how far the point is across a direction.

A direction is two numbers (c, s). Turned by it a point (y, x) is ``v = c y - s x`` across it and ``u = c x + s y``
along it. Where u is positive, ``atan2(y, x) = atan2(s, c) + atan(v / u)`` up to whole turns, and there are none if both
angles are known to be near. For a fixed v this is monotone in u, so its bounds over v and u are those at both ends of
u, each a function of v alone. A second bound knows that v and u hang together: with any number m, ``v / m = t +
v (u - m) / (m u)`` for ``t = v / u``. A third is that of the box of y and x, whose corners are its extreme angles
unless it meets the jump.
"""

from __future__ import annotations

from typing import NamedTuple

from sagemp_cli.checker.balls import arb
from sagemp_cli.checker.clearance import smallest
from sagemp_cli.checker.functions import FUNCTIONS, Smooth
from sagemp_cli.checker.unproved import Unproved

Bounds = tuple[arb, arb]


class Turned(NamedTuple):
    """A point, turned by a direction.

    Attributes:
        cosine, sine: the direction; not both 0.
        across, along: bounds of v and u.
        v, u: their centres.
        plus, minus: bounds of ``|l V + U / l|`` and ``|l V - U / l|``, V and U the deviations from the centres.
    """

    cosine: arb
    sine: arb
    across: Bounds
    along: Bounds
    v: arb
    u: arb
    plus: arb
    minus: arb


def angle_excess(slope: arb, y: Bounds, x: Bounds, turned: Turned) -> Bounds:
    """Bounds of ``atan2(y, x) - slope v``.

    Args:
        slope: any number.
        y, x: bounds of the point.
        turned: the same point.

    Raises:
        Unproved: they are not finite.
    """
    pi = arb.pi()
    low, high = -pi, pi
    if x[0] > 0 or y[0] > 0 or y[1] < 0:
        corners = [arb.atan2(b, a) for b in y for a in x]
        low, high = smallest(corners), -smallest([-c for c in corners])
    ends = [slope * v for v in turned.across]
    least, most = low - ends[0].max(ends[1]), high - ends[0].min(ends[1])
    direction = arb.atan2(turned.sine, turned.cosine)
    # The point's angle and the direction's differ by less than 3 pi / 2, the direction's and atan(v / u) by no more
    # than pi / 2 from the point's up to turns: no room for one.
    if turned.along[0] > 0 and direction - low < 3 * pi / 2 and high - direction < 3 * pi / 2:
        for found in (_at_ends(slope, turned), _twisted(slope, turned)):
            least, most = least.max(found[0] + direction), most.min(found[1] + direction)
    if not (least.is_finite() and most.is_finite()):
        raise Unproved("the angle of a point is not bounded")
    return least, most


def _at_ends(slope: arb, turned: Turned) -> Bounds:
    """Bounds of ``atan(v / u) - slope v`` at both ends of u, and so between them."""
    parts = [_arctangent(u).excess(slope, *turned.across) for u in turned.along]
    return parts[0][0].min(parts[1][0]), parts[0][1].max(parts[1][1])


def _twisted(slope: arb, turned: Turned) -> Bounds:
    """The same with ``v = m t + v (u - m) / u``: ``atan(t) - slope m t``, less ``slope v (u - m) / u``."""
    low, high = turned.along
    quotients = [v / u for v in turned.across for u in (low, high)]
    least, most = FUNCTIONS["atan"].excess(slope * turned.u, smallest(quotients), -smallest([-q for q in quotients]))
    shift = abs(turned.v) * (high - turned.u).max(turned.u - low)
    twist = -(turned.minus**2 / 4 + shift), turned.plus**2 / 4 + shift  # of v (u - m)
    ends = [slope * t / low for t in twist]  # 1 / u is between 0 and this; the twist has both signs
    return least - ends[0].max(ends[1]), most - ends[0].min(ends[1])


def _arctangent(u: arb) -> Smooth:
    """``atan(v / u)`` as a function of v, for a positive u."""
    return Smooth(
        lambda v: (v / u).atan(),
        lambda v: u / (u * u + v * v),
        lambda v: -2 * u * v / (u * u + v * v) ** 2,
    )
