"""A batch of cells, bounded a few at a time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch

from sagemp_cli.reachability.program.loops import RecordedLoop
from sagemp_cli.reachability.propagator import Reach
from sagemp_cli.sets import Box, Tube


def in_blocks(bounded: Callable[[RecordedLoop, Box], Reach], loop: RecordedLoop, start: Box, *, at_once: int) -> Reach:
    """The tube and the notes of all cells.

    Args:
        bounded: of a loop and of cells ``(b, n)``, both of them some of all.
        loop: what steps, with a batch of its own or none.
        start: the cells, ``(*batch, n)``; the loop's batch broadcasts to theirs.
        at_once: cells in one call, at most.
    """
    batch, n = start.lower.shape[:-1], start.dim
    if batch.numel() <= at_once:
        return bounded(loop, start)
    lower, upper = (side.reshape(-1, n) for side in (start.lower, start.upper))
    parts = [
        bounded(some_of(loop, batch, slice(first, first + at_once)), Box(low, high))
        for first, low, high in zip(
            range(0, len(lower), at_once), lower.split(at_once), upper.split(at_once), strict=True
        )
    ]
    sides = (torch.cat([getattr(p.tube, side) for p in parts]) for side in ("lower", "upper"))
    tube = Tube(*(side.reshape(*batch, -1, n) for side in sides))
    return Reach(tube, notes=tuple(dict.fromkeys(note for p in parts for note in p.notes)))


def some_of(loop: RecordedLoop, batch: torch.Size, cells: slice) -> RecordedLoop:
    """The loop of some of the cells of a batch, in one row."""
    if not len(loop.batch):
        return loop
    return dataclasses.replace(loop, numbers=loop.numbers_in(batch).flatten(1, -2)[:, cells])
