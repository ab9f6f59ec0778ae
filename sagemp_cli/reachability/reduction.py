"""Order reduction: enclose a zonotope by one with fewer generators (Girard 2005)."""

from __future__ import annotations

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations.band import UNIT


def reduce_generators(generators: Tensor, limit: int) -> Tensor:
    """Keep the generators that matter most and box the others.

    Sound: the boxed generators ``g_j`` are enclosed by the box of radius ``sum_j |g_j|`` (rounded up).

    Args:
        generators: ``(*batch, n, M)``.
        limit: most generators of the result (at least n+1 are kept).

    Returns:
        ``(*batch, n, min(M, limit))``.
    """
    n, count = generators.shape[-2:]
    limit = max(limit, n + 1)
    if count <= limit:
        return generators
    size = generators.abs()
    # What boxing costs: a generator along an axis loses nothing, so rank by 1-norm minus largest entry, per unit of state scale.
    scale = size.sum(-1, keepdim=True).clamp(min=1e-300)
    weight = size / scale
    loss = weight.sum(-2) - weight.amax(-2)
    order = loss.argsort(dim=-1, descending=True)[..., None, :].expand_as(generators)
    ordered = generators.gather(-1, order)
    kept, boxed = ordered[..., : limit - n], ordered[..., limit - n :]
    radius = boxed.abs().sum(-1) * (1.0 + 2 * (boxed.shape[-1] + 2) * UNIT)
    return torch.cat([kept, torch.diag_embed(radius)], dim=-1)
