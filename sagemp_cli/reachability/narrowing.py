"""Cells that narrow the tube of a loop: those are halved that its hull hangs on, each where that narrows it most."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from sagemp_cli.reachability.halves import Halves
from sagemp_cli.sets import Box, Tube
from sagemp_cli.sets.partition import halved

MOST = 64
"""Cells at most."""

_GAIN = 0.02
"""What doubling the cells must narrow the tube by."""

_PATIENCE = 3
"""Rounds in a row that may gain nothing while the tube is unbounded."""

_WORTH = 0.1
"""Share of the greatest gain a cell from which on another one is halved in the same round, or once more."""

_CUTS = 3
"""Halvings of a cell in one round, at most."""

_AGAIN = 0.25
"""What halving in the same state gains again, of what it gained: errors are of second order in the width."""


def narrowing_cells(bounded: Callable[[Box], tuple[Tube, Halves]], start: Box) -> Tube:
    """Tubes ``(C, K+1, n)`` of cells that cover the start box, one to begin with.

    In each round the cells are halved whose halves are foreseen to narrow the hull of all tubes most, each in the state
    where they do, and once more where that still is worth it; until twice as many cells would narrow it by less than
    2 %, or there are :data:`MOST`.

    Args:
        bounded: of cells ``(C, n)`` the tubes and what halving them would do.
        start: the box, ``(n,)``.
    """
    cells = Box(start.lower[None], start.upper[None])
    tubes, halves = bounded(cells)
    vain = 0
    while len(cells.lower) < MOST:
        worth, made = _cut(cells, _gains(cells, tubes, halves), MOST - len(cells.lower))
        if not len(worth):
            break
        more, their_halves = bounded(made)
        rest = torch.ones(len(cells.lower), dtype=torch.bool)
        rest[worth] = False

        def both(old: Tensor, new: Tensor, rest: Tensor = rest) -> Tensor:
            return torch.cat([old[rest], new])

        found = Tube(both(tubes.lower, more.lower), both(tubes.upper, more.upper))
        doublings = math.log2(len(found.lower) / len(cells.lower))
        gained = _log_width(found.hull()) < _log_width(tubes.hull()) + doublings * math.log(1 - _GAIN)
        vain = 0 if gained else vain + 1
        if not gained and (vain >= _PATIENCE or bool(tubes.hull().bounded)):
            break
        cells, tubes = Box(both(cells.lower, made.lower), both(cells.upper, made.upper)), found
        halves = Halves(both(halves.shift, their_halves.shift), both(halves.narrowing, their_halves.narrowing))
    return tubes


def _cut(cells: Box, gains: Tensor, room: int) -> tuple[Tensor, Box]:
    """Which cells are cut, and what they are cut into.

    Args:
        cells: ``(C, n)``.
        gains: of halving each in each state, ``(C, n)``.
        room: how many cells there may be more.
    """
    gain, _ = gains.max(1)
    least = _WORTH * gain.max()
    worth = torch.nonzero((gain > 0) & (gain >= least)).flatten()
    worth = worth[gain[worth].argsort(descending=True, stable=True)][:room]
    room -= len(worth)
    lowers, uppers = [torch.zeros(0, cells.dim, dtype=torch.float64)], [torch.zeros(0, cells.dim, dtype=torch.float64)]
    for cell in worth.tolist():
        pieces, own = Box(cells.lower[cell, None], cells.upper[cell, None]), gains[cell].clone()
        for count in range(_CUTS):
            added, state = len(pieces.lower), int(own.argmax())
            if count and (added > room or not own[state] / added >= least or not _halvable(pieces, state)):
                break
            pieces = halved(pieces, torch.full((added,), state))
            room -= added if count else 0
            own[state] *= _AGAIN
        lowers.append(pieces.lower)
        uppers.append(pieces.upper)
    return worth, Box(torch.cat(lowers), torch.cat(uppers))


def _halvable(cells: Box, state: int) -> bool:
    """Whether there are numbers between the faces of all."""
    middle = cells.center[:, state]
    return bool(((cells.lower[:, state] < middle) & (middle < cells.upper[:, state])).all())


def _gains(cells: Box, tubes: Tube, halves: Halves) -> Tensor:
    """How much halving each cell in each state would narrow the hull, relative to its width, ``(C, n)``."""
    hull = tubes.hull()
    width = torch.nan_to_num(hull.width, nan=_HUGE, posinf=_HUGE).clamp(min=1 / _HUGE)
    bounded = torch.isfinite(hull.lower) & torch.isfinite(hull.upper)
    gains = torch.zeros_like(cells.lower)
    for i in torch.nonzero(((cells.lower < cells.center) & (cells.center < cells.upper)).any(0)).flatten().tolist():
        made = halves.tubes(tubes, i).hull(1)
        # What a bound falls by counts as far as the cell is the one that reaches farthest, or nearly.
        above = (tubes.upper - made.upper) - (hull.upper - tubes.upper)
        below = (made.lower - tubes.lower) - (tubes.lower - hull.lower)
        fallen = torch.where(bounded, (above.clamp(min=0) + below.clamp(min=0)) / width, 0.0)
        gains[:, i] = torch.nan_to_num(fallen).flatten(1).mean(1)
    if not bool(bounded.all()):  # first of all it is to be bounded: halve what is widest where it still is
        gains = gains + torch.where(tubes.bounded[:, None], 0.0, cells.width / (cells.width.amax() + 1 / _HUGE))
    return torch.where((cells.lower < cells.center) & (cells.center < cells.upper), gains, 0.0)


_HUGE = 1e300


def _log_width(tube: Tube) -> float:
    """Mean over steps after the start and states, of the width's logarithm; huge where it is infinite."""
    width = torch.nan_to_num(tube.width[1:], nan=_HUGE, posinf=_HUGE)
    return float(width.clamp(1 / _HUGE, _HUGE).log().mean())
