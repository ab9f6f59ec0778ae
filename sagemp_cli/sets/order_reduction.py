"""Order reduction: enclose a zonotope by one with fewer generators (Girard 2005).

Two reasons to drop a generator. It may cost *nothing* to have it in a box with others: one along an axis loses nothing
there, and what a step adds is mostly that, to many digits (rounding, remainders, how a disturbance moves the rate of
its own state, errors of what enters one state); or of a neuron that does not straddle its kink, or of an error that
the feedback has contracted for hundreds of steps, hardly more is left than rounding. Or there may be more generators
than a limit allows. Either way what is dropped is enclosed by a box, so both are sound. Not both at once: with a limit,
those that cost nothing are the last to be kept anyway, and boxing them early made tubes wider (by 0.2 %).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.sets.rounding import at_least

NOTHING = 1e-6
"""What boxing generators may cost in all at a time, in every cell of a batch: the sum, over the generators, of their
entries as shares of their coordinates' radii, all but the largest share."""


def reduced(
    generators: Any, limit: int | None = None, *, since: int = 0, radius: np.ndarray | None = None
) -> tuple[Any, np.ndarray | None]:
    """Drop the generators that it costs nothing to box; or if there is a limit, all but those that matter most.

    Sound: the dropped generators ``g_j`` are enclosed by the box of radius ``sum_j |g_j|`` (rounded up).

    Args:
        generators: ``(B, n, M)``, an array or a tensor.
        limit: most generators of the result (at least n+1 are kept); None for no limit.
        since: without a limit, those before this one are kept without a look.
        radius: of each coordinate, more or less, ``(B, n)``; the sum of its entries' sizes by default.

    Returns:
        Generators, the kept ones first and in their old order, then (if any were dropped) the n of the box; and the
        mask of the kept ones, ``(M,)`` if it is the same for the whole batch, else ``(B, M)``, as many in every cell;
        None if all are kept.
    """
    numbers = generators.detach().numpy() if isinstance(generators, Tensor) else generators
    size = np.abs(numbers[..., since:])
    mask = _chosen(size, np.abs(numbers).sum(-1) if radius is None else radius, limit)
    if mask is None:
        return generators, None
    if isinstance(generators, Tensor):
        mask = np.pad(mask, (since, 0), constant_values=True) if since else mask
        return _reduced_tensor(generators, torch.from_numpy(mask)), mask
    if mask.ndim == 1:
        return _reduced_alike(generators, size, mask)
    return _reduced_array(generators, size, mask), mask


def _reduced_tensor(generators: Tensor, mask: Tensor) -> Tensor:
    cells, n, _ = generators.shape
    every = mask.expand(cells, -1)[:, None].expand(generators.shape)
    kept, dropped = (generators[part].reshape(cells, n, -1) for part in (every, ~every))
    return torch.cat([kept, torch.diag_embed(dropped.abs().sum(-1) * at_least(mask.shape[-1]))], dim=-1)


def _reduced_alike(generators: np.ndarray, size: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """With the same mask, of the last ones, for the whole batch; and the mask of all."""
    (cells, n, order), looked_at = generators.shape, len(mask)
    since, chosen = order - looked_at, np.flatnonzero(mask)
    count = since + len(chosen)
    out = np.empty((cells, n, count + n))
    out[..., :since] = generators[..., :since]
    np.take(generators[..., since:], chosen, axis=-1, out=out[..., since:count], mode="clip")
    out[..., count:] = 0.0
    out.reshape(cells, -1)[:, count :: count + n + 1] = (size @ (~mask).astype(float)) * at_least(order)
    whole = np.ones(order, dtype=bool)
    whole[since:] = mask
    return out, whole


def _reduced_array(generators: np.ndarray, size: np.ndarray, mask: np.ndarray) -> np.ndarray:
    cells, n, order = generators.shape
    index = np.nonzero(mask)[1].reshape(cells, 1, -1)
    kept = np.take_along_axis(generators, np.broadcast_to(index, (cells, n, index.shape[-1])), axis=-1)
    dropped = (size @ (~mask).astype(float)[..., None])[..., 0]
    count = kept.shape[-1]
    out = np.zeros((cells, n, count + n))
    out[..., :count] = kept
    out.reshape(cells, -1)[:, count :: count + n + 1] = dropped * at_least(order)
    return out


@np.errstate(all="ignore")  # where a set has overflowed any choice will do
def _chosen(size: np.ndarray, radius: np.ndarray, limit: int | None) -> np.ndarray | None:
    """Which generators are kept, ``(M,)`` or ``(B, M)``, from their absolute values ``(B, n, M)``; None for all.

    Any choice is sound.
    """
    cells, n, count = size.shape
    boxed = 0 if limit is None else count - max(limit, n + 1) + n
    if limit is not None and boxed <= n:
        return None
    share = size / np.maximum(radius, 1e-300)[..., None]
    # A generator along an axis loses nothing in a box.
    loss = np.add.reduce(share, axis=-2) - np.maximum.reduce(share, axis=-2)
    if limit is None:
        loss = np.fmax.reduce(loss, axis=0)
        cheapest = loss.argsort()
        few = int(np.add.accumulate(loss[cheapest]).searchsorted(NOTHING))
        if few <= n:
            return None
        mask = np.ones(count, dtype=bool)
        mask[cheapest[:few]] = False
        return mask
    mask = np.zeros((cells, count), dtype=bool)
    np.put_along_axis(mask, np.argpartition(loss, boxed, axis=-1)[:, boxed:], True, axis=-1)
    return mask
