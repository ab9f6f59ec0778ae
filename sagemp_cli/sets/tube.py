"""Tubes: one box per step, what comes out of a proof."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Tube:
    """A reach set per step: row k of ``lower, upper (..., K+1, n)`` encloses every state at step k (R_0 = X_I)."""

    lower: Tensor
    upper: Tensor

    @property
    def horizon(self) -> int:
        """Number of steps K."""
        return self.lower.shape[-2] - 1

    @property
    def width(self) -> Tensor:
        """``upper - lower``, ``(..., K+1, n)``."""
        return self.upper - self.lower

    @property
    def bounded(self) -> Tensor:
        """Whether every bound is finite, one flag per tube ``(...)``."""
        return (torch.isfinite(self.lower) & torch.isfinite(self.upper)).flatten(-2).all(-1)

    def contains(self, states: Tensor) -> Tensor:
        """Whether whole rollouts ``(..., K+1, n)`` stay inside, one flag per rollout."""
        return ((self.lower <= states) & (states <= self.upper)).flatten(-2).all(-1)

    def intersected(self, other: Tube) -> Tube:
        """What lies in both, of two tubes that enclose the same rollouts."""
        return Tube(torch.maximum(self.lower, other.lower), torch.minimum(self.upper, other.upper))

    def hull(self, dim: int = 0) -> Tube:
        """The union's box hull per step along a batch dimension (the tube of all cells together)."""
        return Tube(self.lower.amin(dim), self.upper.amax(dim))
