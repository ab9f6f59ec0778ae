"""What a choice ``a where c > 0, else b`` is beyond b: d = a - b where c is positive, else 0.

Where c is known to be positive or not it is d or 0, exactly. Else it is enclosed around ``t d`` with t in [0, 1]: what
is left is ``(1 - t) d`` where c is positive and ``-t d`` elsewhere, and d is bounded on either side by itself: it is
``ratio c + rest``, and c is between 0 and one of its own ends. So two branches that meet where c is 0, as those of a
saturation do, cost what a ReLU costs; of any others the hull is taken.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations import lines as _lines
from sagemp_cli.reachability.relaxations.band import Band, settled
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.sets.rounding import TINY, slack


def sides(
    lower: Tensor, upper: Tensor, least: Tensor, most: Tensor, ratio: Tensor, low: Tensor, high: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """What is known of d where a is chosen and where b is.

    Args:
        lower, upper: bounds of d.
        least, most: of c.
        ratio: any finite number.
        low, high: bounds of ``d - ratio c``.

    Returns:
        1, -1 or 0 as c is positive, not positive, or unknown; bounds of d where it is; bounds of d where it is not.
    """
    zero = torch.zeros_like(lower)
    chosen = torch.where(least > 0, 1.0, torch.where(most <= 0, -1.0, zero))
    found = []
    for end in (most.clamp(min=0.0), least.clamp(max=0.0)):
        reach = ratio * end
        doubt = slack(reach.abs() + low.abs() + high.abs(), 8) + TINY
        below, above = reach.clamp(max=0.0) + low - doubt, reach.clamp(min=0.0) + high + doubt
        below, above = torch.fmax(lower, below), torch.fmin(upper, above)
        empty = ~(below <= above)
        found += [torch.where(empty, lower, below), torch.where(empty, upper, above)]
    return chosen, *found


def band(lower: Tensor, upper: Tensor, chosen: Tensor, *bounds: Tensor) -> Band:
    """The band of smallest radius; arguments after the bounds of d are what :func:`sides` gives."""
    a, b, c, d = _within(lower, upper, *bounds)
    share = _best(a, b, c, d)
    least, most = _excess(share, a, b, c, d)
    known = chosen != 0
    radius = 0.5 * (most - least) + slack(least.abs() + most.abs(), 8) + TINY + 0.0 * (lower + upper)
    return settled(
        torch.where(known, chosen.clamp(min=0.0), share),
        torch.where(known, 0.0, 0.5 * (most + least)),
        torch.where(known, 0.0, radius),
    )


def lines(lower: Tensor, upper: Tensor, chosen: Tensor, *bounds: Tensor) -> Lines:
    """Of some pairs of lines the one that is closest at the middle of d, on either side."""
    a, b, c, d = _within(lower, upper, *bounds)
    middle, best = 0.5 * lower + 0.5 * upper, None
    for share in (_best(a, b, c, d), *_candidates(a, b, c, d)):
        least, most = _excess(share, a, b, c, d)
        doubt = slack(least.abs() + most.abs(), 8) + TINY
        pair = Lines(share, least - doubt, share, most + doubt)
        best = pair if best is None else _lines.choose(best, pair, middle)
    assert best is not None
    known, slope = chosen != 0, chosen.clamp(min=0.0)
    parts = zip(best, (slope, torch.zeros_like(slope)) * 2, strict=True)
    return _lines.settled(Lines(*(torch.where(known, exact, part) for part, exact in parts)))


def value_range(lower: Tensor, upper: Tensor, *_: Tensor) -> tuple[Tensor, Tensor]:
    """The hull of d and 0."""
    return lower.clamp(max=0.0), upper.clamp(min=0.0)


def _within(lower: Tensor, upper: Tensor, *bounds: Tensor) -> tuple[Tensor, ...]:
    """Bounds of d on either side, narrowed to what has become known of it since."""
    found = []
    for below, above in (bounds[:2], bounds[2:]):
        below, above = torch.maximum(below, lower), torch.minimum(above, upper)
        empty = below > above
        found += [torch.where(empty, lower, below), torch.where(empty, upper, above)]
    return tuple(found)


def _excess(share: Tensor, a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of what is left of ``share d``, which is in [a, b] where it counts and in [c, d] where it does not."""
    rest = 1.0 - share
    return torch.minimum(rest * a, -share * d), torch.maximum(rest * b, -share * c)


def _candidates(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> list[Tensor]:
    """Where the bounds of what is left have their kinks."""
    zero = torch.zeros_like(a)
    kinks = [(b / (b - c)).nan_to_num(0.5).clamp(0.0, 1.0), (a / (a - d)).nan_to_num(0.5).clamp(0.0, 1.0)]
    return [*kinks, zero, zero + 1.0]


def _best(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    """The share that leaves least: the distance of the bounds is convex and piecewise linear in it."""
    best, width = None, None
    for share in (torch.full_like(a, 0.5), *_candidates(a, b, c, d)):
        least, most = _excess(share, a, b, c, d)
        better = most - least if width is None else torch.minimum(most - least, width)
        best = share if best is None or width is None else torch.where(most - least < width, share, best)
        width = better
    assert best is not None
    return best
