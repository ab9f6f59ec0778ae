"""Order reduction: enclose a zonotope by one with fewer generators (Girard 2005).

Two reasons to drop a generator. It may be *negligible*: of a neuron that does not straddle its kink, or of an error
that the feedback has contracted for hundreds of steps, hardly more is left than rounding; or there may be more
generators than a limit allows. Either way what is dropped is enclosed by a box, so both are sound. Not both at once:
with a limit, negligible ones are the last to be kept anyway, and boxing them early made tubes wider (by 0.2 %).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.sets.rounding import at_least

NEGLIGIBLE = 1e-10
"""A generator is negligible if no entry of it exceeds this share of its coordinate's radius, in no cell of a batch.

A box around m of them adds at most ``m`` times as much to the radius: a millionth for ten thousand."""


def reduced(generators: Any, limit: int | None = None) -> tuple[Any, np.ndarray | None]:
    """Drop negligible generators; or if there is a limit, all but those that matter most.

    Sound: the dropped generators ``g_j`` are enclosed by the box of radius ``sum_j |g_j|`` (rounded up).

    Args:
        generators: ``(B, n, M)``, an array or a tensor.
        limit: most generators of the result (at least n+1 are kept); None for no limit.

    Returns:
        Generators, the kept ones first and in their old order, then (if any were dropped) the n of the box; and the
        mask of the kept ones, ``(M,)`` if it is the same for the whole batch, else ``(B, M)``, as many in every cell;
        None if all are kept.
    """
    if isinstance(generators, Tensor):
        mask = _chosen(np.abs(generators.detach().numpy()), limit)
        return (generators, None) if mask is None else (_reduced_tensor(generators, torch.from_numpy(mask)), mask)
    size = np.abs(generators)
    mask = _chosen(size, limit)
    return (generators, None) if mask is None else (_reduced_array(generators, size, mask), mask)


def _reduced_tensor(generators: Tensor, mask: Tensor) -> Tensor:
    cells, n, _ = generators.shape
    every = mask.expand(cells, -1)[:, None].expand(generators.shape)
    kept, dropped = (generators[part].reshape(cells, n, -1) for part in (every, ~every))
    return torch.cat([kept, torch.diag_embed(dropped.abs().sum(-1) * at_least(mask.shape[-1]))], dim=-1)


def _reduced_array(generators: np.ndarray, size: np.ndarray, mask: np.ndarray) -> np.ndarray:
    cells, n, _ = generators.shape
    if mask.ndim == 1:
        kept, dropped = generators[..., mask], size @ (~mask).astype(float)
    else:
        index = np.nonzero(mask)[1].reshape(cells, 1, -1)
        kept = np.take_along_axis(generators, np.broadcast_to(index, (cells, n, index.shape[-1])), axis=-1)
        dropped = (size @ (~mask).astype(float)[..., None])[..., 0]
    count = kept.shape[-1]
    out = np.zeros((cells, n, count + n))
    out[..., :count] = kept
    out.reshape(cells, -1)[:, count :: count + n + 1] = dropped * at_least(size.shape[-1])
    return out


@np.errstate(all="ignore")  # where a set has overflowed any choice will do
def _chosen(size: np.ndarray, limit: int | None) -> np.ndarray | None:
    """Which generators are kept, ``(M,)`` or ``(B, M)``, from their absolute values ``(B, n, M)``; None for all.

    Any choice is sound.
    """
    cells, n, count = size.shape
    boxed = 0 if limit is None else count - max(limit, n + 1) + n
    if limit is not None and boxed <= n:
        return None
    radius = np.add.reduce(size, axis=-1)[..., None]
    if limit is None:
        mask = (size > NEGLIGIBLE * radius).any((0, 1))
        return mask if int(mask.sum()) + n < count else None
    # What boxing costs: a generator along an axis loses nothing, so rank by 1-norm minus largest entry, per unit of
    # state scale.
    weight = size / np.maximum(radius, 1e-300)
    loss = np.add.reduce(weight, axis=-2) - np.maximum.reduce(weight, axis=-2)
    mask = np.zeros((cells, count), dtype=bool)
    np.put_along_axis(mask, np.argpartition(loss, boxed, axis=-1)[:, boxed:], True, axis=-1)
    return mask
