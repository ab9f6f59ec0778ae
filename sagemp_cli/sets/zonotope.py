"""Zonotopes: sets ``c + G [-1, 1]^M``, for arrays and tensors alike."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.sets.box import Box
from sagemp_cli.sets.order_reduction import reduced
from sagemp_cli.sets.rounding import at_least, slack

Array = Any
"""A numpy array or a tensor; all of one zonotope's are of one kind."""


@dataclass(frozen=True, eq=False)
class Zonotope:
    """The points ``center + generators @ eps`` with ``eps`` in ``[-1, 1]^M``; a batch of them is one for each cell.

    The center and the generators are the exact numbers stored.

    Attributes:
        center: ``(..., n)``.
        generators: ``(..., n, M)``.
    """

    center: Array
    generators: Array

    @staticmethod
    def of(box: Box) -> Zonotope:
        """A box ``(..., n)`` as a zonotope that encloses it, with one generator per side; of tensors."""
        return Zonotope(box.center, torch.diag_embed(box.radius))

    @property
    def dim(self) -> int:
        """Number of dimensions n."""
        return self.center.shape[-1]

    @property
    def order(self) -> int:
        """Number of generators M."""
        return self.generators.shape[-1]

    @functools.cached_property
    def reach(self) -> Array:
        """Upper bound of ``|x - center|`` per dimension, ``(..., n)``."""
        return abs(self.generators).sum(-1) * at_least(self.order)

    @functools.cached_property
    def _spread(self) -> Array:
        """What center and reach differ by, and as much as the subtraction itself is rounded by."""
        return self.reach + slack(self.reach + abs(self.center), 2)

    @property
    def low(self) -> Array:
        """Lower bounds ``(..., n)``."""
        return self.center - self._spread

    @property
    def high(self) -> Array:
        """Upper bounds ``(..., n)``."""
        return self.center + self._spread

    def enclose(self) -> Box:
        """The smallest box around it, rounded outwards; of tensors."""
        low, high = (torch.from_numpy(s) if isinstance(s, np.ndarray) else s for s in (self.low, self.high))
        return Box(low, high)

    def affine_map(self, matrix: Array, center: Array, *, fresh: Array, radius: Array, rounding: Array) -> Zonotope:
        """``center + matrix (x - self.center) + fresh v + [-rounding, rounding]`` with ``|v| <= radius``.

        ``rounding`` has to cover that of computing the new generators: products with ``matrix``, sums of n terms.

        Args:
            matrix: ``(B, m, n)``, or for all cells ``(1, m, n)``.
            center: ``(B, m)``.
            fresh: ``(B, m, l)`` or ``(1, m, l)``.
            radius: ``(l,)`` or ``(B, 1, l)``.
            rounding: ``(B, m)``.
        """
        if not isinstance(center, np.ndarray):
            old = matrix @ self.generators
            parts = [old, (fresh * radius).expand(*old.shape[:-1], -1), torch.diag_embed(rounding)]
            return Zonotope(center, torch.cat(parts, dim=-1))
        (cells, m), count, more = center.shape, self.order, fresh.shape[-1]
        generators = np.empty((cells, m, count + more + m))
        np.matmul(matrix, self.generators, out=generators[..., :count])
        np.multiply(fresh, radius, out=generators[..., count : count + more])
        generators[..., count + more :] = 0.0
        generators.reshape(cells, -1)[:, count + more :: count + more + m + 1] = rounding
        return Zonotope(center, generators)

    def reduce_order(self, limit: int | None = None, *, since: int = 0) -> tuple[Zonotope, np.ndarray | None]:
        """An enclosure with fewer generators, and which were kept: see :mod:`sagemp_cli.sets.order_reduction`."""
        radius = self.reach.detach().numpy() if isinstance(self.reach, Tensor) else self.reach
        generators, mask = reduced(self.generators, limit, since=since, radius=radius)
        return (self, None) if mask is None else (Zonotope(self.center, generators), mask)

    def settled(self) -> tuple[Zonotope, Array | None]:
        """Itself; or, where some of a batch have overflown, with NaN for these and which they are, ``(B,)``."""
        if math.isfinite(self.reach.sum().item()):
            return self, None
        m = torch if isinstance(self.center, Tensor) else np
        bad = ~m.isfinite(self.reach).all(-1)
        center = m.where(bad[:, None], math.nan, self.center)
        return Zonotope(center, m.where(bad[:, None, None], math.nan, self.generators)), bad
