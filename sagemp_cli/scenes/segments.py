"""Straight lines between the points of a path: where they come nearest to an obstacle, or deepest into it.

In floating-point, for rollouts: searches, figures and counts. What is proved uses boxes or rigorous arithmetic.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

_HALVINGS = 40
"""Of a step, so that the place is known to 1e-12 of it."""


def along(path: Tensor, fraction: Tensor) -> Tensor:
    """The points ``(..., K, d)`` at a fraction ``(..., K)`` of each straight piece of paths ``(..., K+1, d)``.

    Gradients go through the ends of the pieces, not through the fraction: where it is the nearest one, the distance
    does not change with it to first order.
    """
    s = fraction.detach()[..., None]
    return (1.0 - s) * path[..., :-1, :] + s * path[..., 1:, :]


def deepest(path: Tensor, lower: Tensor, upper: Tensor, distance: Callable[[Tensor], Tensor]) -> Tensor:
    """Where in [0, 1] the signed distance to an axis-aligned block is least on each piece of paths, ``(..., K)``.

    The distance to a convex set is convex along a line, so its slope says on which side the least one is.

    Args:
        path: ``(..., K+1, d)``.
        lower, upper: corners of the block, ``(d,)``.
        distance: the signed distance of points.
    """
    with torch.no_grad():
        first, way = path[..., :-1, :], path.diff(dim=-2)
        begin = torch.zeros(first.shape[:-1], dtype=path.dtype)
        end = torch.ones_like(begin)
        for _ in range(_HALVINGS):
            middle = 0.5 * (begin + end)
            rising = _slope(first + middle[..., None] * way, way, lower, upper) > 0
            begin, end = torch.where(rising, begin, middle), torch.where(rising, middle, end)
        places = torch.stack([torch.zeros_like(begin), 0.5 * (begin + end), torch.ones_like(begin)])
        return places.gather(0, distance(first + places[..., None] * way).argmin(0, keepdim=True))[0]


def _slope(points: Tensor, way: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Of the signed distance along the way, up to a positive factor: of all gaps outside, of the largest one inside."""
    below, above = lower - points, points - upper
    gap, growth = torch.maximum(below, above), torch.where(above >= below, way, -way)
    inside = growth.gather(-1, gap.argmax(-1, keepdim=True))[..., 0]
    return torch.where(gap.amax(-1) > 0, (gap.clamp(min=0.0) * growth).sum(-1), inside)
