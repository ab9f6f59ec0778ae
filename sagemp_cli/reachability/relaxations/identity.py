"""The identity as a relaxation: what depends on others is forgotten, its bounds are kept."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations.band import Band, settled
from sagemp_cli.reachability.relaxations.functions import functions_of
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.sets.rounding import TINY, gamma


def band(lower: Any, upper: Any) -> Band:
    """A constant band; of tensors or of arrays."""
    center = 0.5 * (lower + upper)
    radius = functions_of(lower).maximum(upper - center, center - lower) * (1.0 + gamma(4)) + TINY
    return settled(0.0 * center, center, radius)


def lines(lower: Tensor, upper: Tensor) -> Lines:
    """Two constants."""
    level = torch.zeros_like(lower)
    return Lines(level, lower, level, upper)


def value_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """The ends."""
    return lower, upper
