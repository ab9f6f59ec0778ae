"""The few things that arrays and tensors do differently: what arrays do in place is made anew of tensors."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor


def with_fresh(coefficients: Any, factor: Any, size: int, radius: Any) -> Any:
    """``factor * coefficients`` as coefficients of ``size`` variables, and one more variable of that radius per entry.

    Args:
        coefficients: ``(B, e, variables)`` or ``(1, e, variables)``.
        factor: a number, or ``(B, e, 1)``.
        size: at least as many as there are variables.
        radius: ``(B, e)``.
    """
    cells, entries = radius.shape
    if not isinstance(radius, np.ndarray):
        scaled = (coefficients * factor).expand(cells, -1, -1)
        return torch.cat(
            [torch.nn.functional.pad(scaled, (0, size - scaled.shape[-1])), torch.diag_embed(radius)], dim=-1
        )
    out = np.zeros((cells, entries, size + entries))
    np.multiply(coefficients, factor, out=out[..., : coefficients.shape[-1]])
    out.reshape(cells, -1)[:, size :: size + entries + 1] = radius
    return out


def applied(matrix: Any, coefficients: Any, fresh: Any) -> Any:
    """``matrix @ coefficients``, of which the last columns are a diagonal if it is known, ``(B, e)``.

    Args:
        matrix: ``(rows, e)``.
        coefficients: ``(B, e, variables)``.
        fresh: the diagonal; None if there is none.
    """
    if fresh is None or not isinstance(fresh, np.ndarray) or fresh.shape[-1] < WIDE:
        return matrix @ coefficients
    (cells, entries), variables = fresh.shape, coefficients.shape[-1]
    out = np.empty((cells, len(matrix), variables))
    np.matmul(matrix, coefficients[..., :-entries], out=out[..., :-entries])
    np.multiply(matrix, fresh[:, None], out=out[..., -entries:])
    return out


WIDE = 48
"""Entries from which on a diagonal is worth a call of its own."""


def added(total: Any, part: Any) -> Any:
    """The sum of coefficients, of which the second may have fewer variables; the first is used up."""
    if total is None:
        return part
    if isinstance(total, np.ndarray):
        total[..., : part.shape[-1]] += part
        return total
    return total + torch.nn.functional.pad(part, (0, total.shape[-1] - part.shape[-1]))


def widened(coefficients: Any, size: int) -> Any:
    """Coefficients of so many variables, those that are not there 0."""
    missing = size - coefficients.shape[-1]
    if not missing:
        return coefficients
    if isinstance(coefficients, Tensor):
        return torch.nn.functional.pad(coefficients, (0, missing))
    return np.concatenate([coefficients, np.zeros((*coefficients.shape[:-1], missing))], axis=-1)


def repeated(x: Any, count: int, axis: int = 0) -> Any:
    """One entry along an axis as so many."""
    if isinstance(x, Tensor):
        return x.expand(*x.shape[:axis], count, *x.shape[axis + 1 :])
    return np.repeat(x, count, axis=axis)


def like(tensor: Tensor, x: Any) -> Any:
    """A tensor in the shape of the other, as an array if that is one."""
    shaped = tensor.reshape(x.shape)
    return shaped if isinstance(x, Tensor) else shaped.numpy()
