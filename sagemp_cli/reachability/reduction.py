"""Order reduction: enclose a zonotope by one with fewer generators (Girard 2005).

Two reasons to drop a generator. It may be *negligible*: of a neuron that does not straddle its kink, or of an error
that the feedback has contracted for hundreds of steps, hardly more is left than rounding; or there may be more
generators than a limit allows. Either way what is dropped is enclosed by a box, so both are sound.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations.band import UNIT

NEGLIGIBLE = 1e-10
"""A generator is negligible if no entry of it exceeds this share of its coordinate's radius, in no cell of a batch.

A box around m of them adds at most ``m`` times as much to the radius: a millionth for ten thousand."""


def reduce_generators(generators: Tensor, limit: int | None = None) -> tuple[Tensor, Tensor]:
    """Drop negligible generators, and if there are more than ``limit`` then, keep those that matter most.

    Sound: the dropped generators ``g_j`` are enclosed by the box of radius ``sum_j |g_j|`` (rounded up).

    Args:
        generators: ``(*batch, n, M)``.
        limit: most generators of the result (at least n+1 are kept); None for no limit.

    Returns:
        Generators, the kept ones first and in their old order, then (if any were dropped) the n of the box; and the
        mask of the kept ones, ``(M,)`` if it is the same for the whole batch, else ``(*batch, M)``.
    """
    n, count = generators.shape[-2:]
    with torch.no_grad():  # what is kept is a choice: any is sound
        size = generators.abs()
        radius = size.sum(-1, keepdim=True)
        mask = (size > NEGLIGIBLE * radius).flatten(0, -2).any(0)
        index = mask.nonzero()[:, 0]
    limit = count if limit is None else max(limit, n + 1)
    if index.shape[0] + n <= limit and index.shape[0] + n < count:
        dropped = (~mask).nonzero()[:, 0]
        return _boxed(generators.index_select(-1, index), generators.index_select(-1, dropped)), mask
    if count <= limit:
        return generators, torch.ones_like(mask)
    # What boxing costs: a generator along an axis loses nothing, so rank by 1-norm minus largest entry, per unit of
    # state scale.
    weight = size / radius.clamp(min=1e-300)
    loss = weight.sum(-2) - weight.amax(-2)
    order = loss.argsort(dim=-1, descending=True)
    index = order[..., : limit - n].sort(dim=-1).values
    kept = generators.gather(-1, index[..., None, :].expand(*generators.shape[:-1], -1))
    boxed = generators.gather(-1, order[..., None, limit - n :].expand(*generators.shape[:-1], -1))
    return _boxed(kept, boxed), torch.zeros_like(loss, dtype=torch.bool).scatter_(-1, index, True)


def _boxed(kept: Tensor, dropped: Tensor) -> Tensor:
    """The kept generators and a box around the sum of the others."""
    radius = dropped.abs().sum(-1) * (1.0 + 2 * (dropped.shape[-1] + 2) * UNIT)
    return torch.cat([kept, torch.diag_embed(radius)], dim=-1)
