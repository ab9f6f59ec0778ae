"""The point of a convex or concave piece whose derivative is a given slope, where it has no closed form."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def by_regula_falsi(derivative: Callable[[Tensor], Tensor]) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
    """What :class:`~.pieces.Piece` asks of a touch, from slope, start and end: where a derivative that is monotone on
    the piece is nearest to the slope (Illinois variant).
    """

    def touch(slope: Tensor, start: Tensor, end: Tensor) -> Tensor:
        left, right = start, end
        at_left, at_right = derivative(left) - slope, derivative(right) - slope
        beyond, nearest = at_left * at_right > 0, torch.where(at_left.abs() < at_right.abs(), left, right)
        t, near, before = left, 1e-6 * (at_right - at_left).abs(), torch.zeros_like(left, dtype=torch.bool)
        for i in range(10):
            drop = at_right - at_left
            t = torch.where(drop == 0, left, right - at_right * (right - left) / drop)
            t = torch.minimum(torch.fmax(t, left), right)
            at = derivative(t) - slope
            if bool((beyond | (at.abs() <= near)).all()):
                break
            # The end that stays for the second time counts half.
            same = (at > 0) == (at_right > 0)
            stays = torch.where(same == before, 0.5, 1.0) if i else 1.0
            left, at_left = torch.where(same, left, t), torch.where(same, at_left * stays, at)
            right, at_right = torch.where(same, t, right), torch.where(same, at, at_right * stays)
            before = same
        return torch.where(beyond, nearest, t)

    return touch
