"""Partitions of a start box: how many cells along which dimension, and the cells."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from sagemp_cli.errors import ConfigError
from sagemp_cli.sets import Box

_PRODUCT = re.compile(r"^\d+(x\d+)*$")


AUTO = "auto"
"""The word for an adaptive partition."""


def parse_partitions(value: Any, uncertain_dims: int, *, auto: bool = False) -> list[int] | None:
    """Cells per uncertain start dimension, from what a user writes.

    Args:
        value: the number of cells in all (``4``), which is factored as evenly as possible, larger factors first
            (4 over two dimensions is 2 x 2, 6 is 3 x 2, 5 is 5 x 1), or counts per uncertain dimension
            (``"2x2"`` or ``[2, 2]``).
        uncertain_dims: number of start dimensions of positive width.
        auto: whether ``"auto"`` is allowed, which gives None: no counts, the partition is adaptive.

    Raises:
        ConfigError: anything else, e.g. 0 or "4x".
    """
    if uncertain_dims < 1:
        raise ConfigError("partitions: the start box is a single point, there is nothing to partition")
    if auto and isinstance(value, str) and value.strip() == AUTO:
        return None
    example = f"{uncertain_dims} counts such as {'x'.join(['2'] * uncertain_dims)}"
    allowed = (
        f"a positive number of cells in all, {example}, or auto"
        if auto
        else (f"a positive number of cells in all, or {example}")
    )
    counts: list[int] = []
    if isinstance(value, str) and _PRODUCT.match(value.strip()):
        counts = [int(part) for part in value.strip().split("x")]
    elif isinstance(value, int) and not isinstance(value, bool):
        counts = [value]
    elif isinstance(value, Sequence) and all(isinstance(v, int) and not isinstance(v, bool) for v in value):
        counts = list(value)
    if not counts or min(counts) < 1:
        raise ConfigError(f"partitions must be {allowed}; found {value!r}")
    if len(counts) == 1 and isinstance(value, int | str):
        return _even_factors(counts[0], uncertain_dims)
    if len(counts) != uncertain_dims:
        raise ConfigError(f"partitions must be {allowed}; found {len(counts)} counts in {value!r}")
    return counts


def _even_factors(cells: int, dims: int) -> list[int]:
    """``dims`` factors of ``cells`` whose largest is as small as can be, in descending order."""
    if dims == 1:
        return [cells]
    small = [d for d in range(1, math.isqrt(cells) + 1) if cells % d == 0]
    divisors = {*small, *(cells // d for d in small)}
    return min(sorted([d, *_even_factors(cells // d, dims - 1)], reverse=True) for d in divisors)


def partition(start: Box, counts: Sequence[int]) -> Box:
    """Uniform cells ``(..., C, n)`` that cover the start boxes ``(..., n)`` without gaps.

    Args:
        start: one box, or a batch of boxes that are uncertain in the same dimensions.
        counts: cells per uncertain dimension (positive width), in order; their product is C.
    """
    uncertain = uncertain_dimensions(start)
    if len(counts) != len(uncertain):
        raise ConfigError(
            f"partition needs one count for each of {len(uncertain)} uncertain dimensions, found {counts}"
        )
    full = [1] * start.dim
    for dimension, count in zip(uncertain, counts, strict=True):
        full[dimension] = int(count)
    flat_lower, flat_upper = start.lower.reshape(-1, start.dim), start.upper.reshape(-1, start.dim)
    cells = [Box(low, high).split(full) for low, high in zip(flat_lower, flat_upper, strict=True)]
    shape = (*start.lower.shape[:-1], -1, start.dim)
    return Box(
        torch.stack([c.lower for c in cells]).reshape(shape), torch.stack([c.upper for c in cells]).reshape(shape)
    )


def halved(cells: Box, dimension: Tensor) -> Box:
    """Both halves of every cell ``(C, n)``, each in a dimension of its own ``(C,)``, one after the other, ``(2C, n)``.

    They share their face exactly, and so cover the cell.
    """
    own = torch.nn.functional.one_hot(dimension, cells.dim).bool()
    middle = cells.center
    lower = torch.stack([cells.lower, torch.where(own, middle, cells.lower)], 1)
    upper = torch.stack([torch.where(own, middle, cells.upper), cells.upper], 1)
    return Box(lower.flatten(0, 1), upper.flatten(0, 1))


def uncertain_dimensions(start: Box) -> list[int]:
    """Dimensions of positive width in any of the boxes ``(..., n)``."""
    return torch.nonzero((start.width > 0).reshape(-1, start.dim).any(0)).flatten().tolist()
