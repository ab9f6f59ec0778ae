"""In which state a cell is best halved, by the tubes of its halves as they are foreseen."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from sagemp_cli.reachability.halves import Halves
from sagemp_cli.sets import Box, Tube

_TIE = 1e-6
"""Relative difference of what is missing below which the narrower tubes decide."""


def best_cut(cells: Box, tube: Tube, halves: Halves, missing: Callable[[Tube], Tensor]) -> Tensor:
    """The state in which to halve each cell, so that its halves miss least together; -1 if it cannot be halved, (C,).

    Args:
        cells: ``(C, n)``.
        tube: of each, ``(C, K+1, n)``.
        halves: what halving would do.
        missing: of tubes, how far each is from proving what is claimed.
    """
    count, n = cells.lower.shape
    middle = cells.center
    possible = (cells.lower < middle) & (middle < cells.upper)  # else there is no number between the faces
    least, spread = torch.full((2, count, n), torch.inf, dtype=torch.float64)
    for i in torch.nonzero(possible.any(0)).flatten().tolist():
        found = halves.tubes(tube, i)
        least[:, i] = torch.nan_to_num(
            missing(Tube(found.lower.flatten(0, 1), found.upper.flatten(0, 1))).unflatten(0, (count, 2)).sum(1)
        )
        width = torch.nan_to_num(found.width, nan=1e300, posinf=1e300).clamp(1e-300, 1e300)
        spread[:, i] = width.log().flatten(1).mean(1)
    least[~possible], spread[~possible] = torch.inf, torch.inf
    tied = least <= least.amin(1, keepdim=True) * (1 + _TIE)
    return torch.where(possible.any(1), torch.where(tied, spread, torch.inf).argmin(1), -1)


def cut_gains(cells: Box, tube: Tube, halves: Halves) -> Tensor:
    """By how much halving each cell in each state would narrow its tube after the start: the hull of both halves beside
    it, as the mean of logarithms, ``(C, n)``; 0 where it cannot be halved.

    So it counts what both halves are narrower by, and not that each holds but half of the states.
    """
    width = torch.nan_to_num(tube.width, nan=1e300, posinf=1e300).clamp(1e-200, 1e300)
    gains = torch.zeros_like(cells.lower)
    for i in range(cells.dim):
        hull = halves.tubes(tube, i).hull(1)
        left = torch.nan_to_num(hull.width, nan=1e300, posinf=1e300).clamp(1e-200, 1e300)
        gains[:, i] = (width.log() - left.log())[:, 1:].mean((1, 2))
    return torch.where((cells.lower < cells.center) & (cells.center < cells.upper), gains, 0.0)
