"""Into how many parts a period is cut, where nobody says: so many that remainders are a small share of the tube.

What a Taylor polynomial leaves out goes into the tube as an interval that nothing contracts. Its width over a period
beside the width of the tube says whether more parts would help: halving a part divides it by ``2^p`` a period.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol, TypeVar

import torch
from torch import Tensor

from sagemp_cli.reachability.flow import Division, Flow
from sagemp_cli.reachability.propagator import Reach

ENOUGH = 0.05
"""Share of the tube's width that the remainders of a period may have, to begin with."""

FINE = 0.002
"""The share from which on more parts would not narrow the tube."""

_PROGRESS = 0.8
"""Share of the periods without enclosure that may be left by a finer division, for it to go on."""

MOST_SUBSTEPS = 32
"""Parts of a period at most, where the number is not asked for."""

FLOOR = 0.01
"""A tube that is narrower than this share of how far it goes counts as that wide, before anything says otherwise."""

_NOTHING = 1e-200
"""What only keeps rounding honest where a remainder is 0."""


def remainder_share(reach: Reach, floor: float = 0.0) -> Tensor:
    """Of each cell, the share ``r / (r + b)`` that remainders of width r in a period have beside a tube of width b, the
    mean over states; ``(C,)``. One state that hardly varies, and of which remainders are all, does not decide.

    The median over the periods that have an enclosure, so that where a tube explodes in the end, what it did before
    counts; infinite where there is none. A width counts as at least ``floor`` times how far the tube goes.
    """
    flow = reach.flow
    assert flow is not None
    left_out = (flow.remainder_upper - flow.remainder_lower).sum(2)
    lower, upper = reach.tube.lower[:, 1:], reach.tube.upper[:, 1:]
    known = torch.isfinite(left_out) & torch.isfinite(lower) & torch.isfinite(upper)
    top, bottom = torch.where(known, upper, -torch.inf).amax(1), torch.where(known, lower, torch.inf).amin(1)
    width = torch.maximum(upper - lower, floor * (top - bottom)[:, None])
    share = torch.where(left_out <= _NOTHING, 0.0, left_out / (left_out + width))
    share = torch.where(known, share, torch.nan).nanmedian(1).values
    return torch.nan_to_num(share, nan=torch.inf).mean(-1)


ORDERS = (2, 3)
"""Degrees of the Taylor polynomials, at first, and where that does not do."""


def finer(division: Division, substeps: int | None, order: int | None) -> Division | None:
    """The next division to try: a higher order, then twice as many parts; None if there is none.

    Args:
        division: what did not do.
        substeps, order: None where it may be changed.
    """
    if order is None and division.order < ORDERS[-1]:
        return Division(division.substeps, ORDERS[-1])
    if substeps is None and 2 * division.substeps <= MOST_SUBSTEPS:
        return Division(2 * division.substeps, division.order)
    return None


class Tried(Protocol):
    """What a division gave."""

    @property
    def flow(self) -> Flow | None:
        """What was proved between the instants."""
        ...


T = TypeVar("T", bound=Tried)


def chosen(
    tried: Callable[[Division], T],
    begin: Division,
    *,
    substeps: int | None,
    order: int | None,
    share: Callable[[T], float] | None = None,
) -> tuple[Division, T]:
    """The best of finer and finer divisions, and what it gave: of as many as leave a good deal fewer periods without an
    enclosure or too large a share to remainders.

    Args:
        tried: what a division gives.
        begin: the first.
        substeps, order: None where it may be changed.
        share: of remainders in what a division gave, which may be :data:`ENOUGH`; None where it does not matter, if
            only every period has an enclosure.
    """
    division: Division | None = begin
    best: tuple[Division, T] | None = None
    least, lost = math.inf, math.inf
    while division is not None:
        found = tried(division)
        size, now = 0.0 if share is None else share(found), periods_lost(found)
        if best is None or size < least or now < lost:
            best, least = (division, found), size
        assert found.flow is not None
        in_vain = 0 < now < found.flow.lower.shape[1] and now > _PROGRESS * lost
        if (size <= ENOUGH and (now == 0 or share is not None)) or in_vain:
            break
        division, lost = finer(division, substeps, order), min(now, lost)
    assert best is not None
    return best


def periods_lost(found: Tried) -> int:
    """Periods of which the worst cell has no enclosure."""
    flow = found.flow
    assert flow is not None
    known = torch.isfinite(flow.remainder_lower) & torch.isfinite(flow.remainder_upper)
    return int((~known.flatten(2).all(-1)).sum(1).amax())
