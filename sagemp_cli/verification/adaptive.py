"""Adaptive partitions: cells are split where the proof fails, in the state where that is foreseen to help most.

A partition begins with one cell per reference. In each round every cell whose tube is not SAFE by itself is halved, in
the state whose halves are foreseen to miss least together (:mod:`sagemp_cli.verification.cutting`), the halves of all
references in one batch. Rounds go on until all is SAFE, the budget is spent, or it is plain that a reference will not
be proved: a rollout breaks the claim, or splitting has not helped several times in a row. Halves share their face
exactly (:meth:`~sagemp_cli.sets.Box.split`), so the cells always cover the start box.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from sagemp_cli.sets import Box
from sagemp_cli.sets.partition import halved
from sagemp_cli.verification.cells import CellTubes

PATIENCE = 3
"""Splits in a row that may be in vain, before a cell, and with it its reference, is given up."""

GAIN = 0.02
"""A split is in vain if its halves miss on average more than ``1 - GAIN`` of what the whole cell missed."""


def adaptive_cells(
    prove: Callable[[Tensor, Box], CellTubes],
    start: Box,
    *,
    budget: int,
    shortfall: Callable[[CellTubes], tuple[Tensor, Tensor]],
    hopeless: Callable[[Tensor, Box], Tensor],
) -> CellTubes:
    """Cells that cover each start box, at most ``budget`` for each, split where it pays.

    What this costs: two propagated cells for each split.

    Args:
        prove: ``prove(cell_reference (B,), cells (B, n))``, the tubes of cells and where to cut them.
        start: X_I of each reference, ``(R, n)``.
        budget: cells of one reference at most.
        shortfall: of cells, whether each is SAFE and how much is missing; see
            :func:`~sagemp_cli.verification.verdict.shortfall`.
        hopeless: ``hopeless(cell_reference (B,), cells (B, n))`` says of which cells a rollout is known that breaks the
            claim; a reference with such a cell is split no further.

    Returns:
        The cells, sorted by reference and corner. They cover every start box whether or not all of them are SAFE.
    """
    count = len(start.lower)
    found = prove(torch.arange(count), start)
    given_up = torch.zeros(count, dtype=torch.bool)
    fresh = torch.ones(count, dtype=torch.bool)  # cells that were not yet tried for a violating rollout
    vain = torch.zeros(count, dtype=torch.int64)  # splits in a row that did not help, per cell
    while True:
        safe, missing = shortfall(found)
        doubtful = torch.nonzero(fresh & ~safe).flatten()
        owners = found.cell_reference[doubtful]
        if len(doubtful):
            given_up[owners[hopeless(owners, _box(found, doubtful))]] = True
        given_up[found.cell_reference[(vain >= PATIENCE) & ~safe]] = True
        fresh.zero_()
        assert found.cut is not None
        done = safe | given_up[found.cell_reference] | (found.cut < 0)
        split = _worst(found.cell_reference, done, missing, budget)
        if not len(split):
            break
        halves = halved(_box(found, split), found.cut[split])
        made = prove(found.cell_reference[split].repeat_interleave(2), halves)
        left = shortfall(made)[1].unflatten(0, (-1, 2)).sum(1)
        more = torch.where(left > 2 * (1 - GAIN) * missing[split], vain[split] + 1, 0)
        whole = torch.ones(len(found), dtype=torch.bool)
        whole[split] = False
        found = CellTubes.join([found.select(torch.nonzero(whole).flatten()), made])
        fresh = torch.cat([fresh[whole], torch.ones(len(made), dtype=torch.bool)])
        vain = torch.cat([vain[whole], more.repeat_interleave(2)])
    return found.select(_sorted(found))


def _box(found: CellTubes, index: Tensor) -> Box:
    return Box(found.cells.lower[index], found.cells.upper[index])


def _worst(owner: Tensor, done: Tensor, missing: Tensor, budget: int) -> Tensor:
    """The cells to split: of each reference those that miss most, as many as its budget has room for."""
    room = budget - owner.bincount()
    chosen = []
    for cell in missing.argsort(descending=True, stable=True).tolist():
        if not done[cell] and room[owner[cell]] > 0:
            room[owner[cell]] -= 1
            chosen.append(cell)
    return torch.tensor(chosen, dtype=torch.int64)


def _sorted(found: CellTubes) -> Tensor:
    """The cells' order by reference, then by lower corner."""
    keys = zip(found.cell_reference.tolist(), found.cells.lower.tolist(), range(len(found)), strict=True)
    return torch.tensor([cell for *_, cell in sorted(keys)], dtype=torch.int64)
