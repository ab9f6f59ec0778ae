"""Order reduction: enclose a zonotope by one with fewer generators (Girard 2005)."""

from __future__ import annotations

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations.band import UNIT


def reduce_generators(generators: Tensor, limit: int) -> tuple[Tensor, Tensor]:
    """Keep the generators that matter most and box the others.

    Sound: the boxed generators ``g_j`` are enclosed by the box of radius ``sum_j |g_j|`` (rounded up).

    Args:
        generators: ``(*batch, n, M)``.
        limit: most generators of the result (at least n+1 are kept).

    Returns:
        Generators ``(*batch, n, min(M, limit))``, the kept ones first and in their old order, and the mask of the
        kept ones ``(*batch, M)``.
    """
    n, count = generators.shape[-2:]
    limit = max(limit, n + 1)
    mask = torch.ones(*generators.shape[:-2], count, dtype=torch.bool)
    if count <= limit:
        return generators, mask
    size = generators.abs()
    # What boxing costs: a generator along an axis loses nothing, so rank by 1-norm minus largest entry, per unit of
    # state scale.
    scale = size.sum(-1, keepdim=True).clamp(min=1e-300)
    weight = size / scale
    loss = weight.sum(-2) - weight.amax(-2)
    order = loss.argsort(dim=-1, descending=True)
    index = order[..., : limit - n].sort(dim=-1).values
    kept = generators.gather(-1, index[..., None, :].expand(*generators.shape[:-1], -1))
    boxed = generators.gather(-1, order[..., None, limit - n :].expand(*generators.shape[:-1], -1))
    radius = boxed.abs().sum(-1) * (1.0 + 2 * (boxed.shape[-1] + 2) * UNIT)
    mask = torch.zeros_like(mask).scatter_(-1, index, True)
    return torch.cat([kept, torch.diag_embed(radius)], dim=-1), mask
