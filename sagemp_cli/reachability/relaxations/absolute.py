"""Absolute value: the leaky ReLU of slope -1."""

from __future__ import annotations

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations import leaky_relu
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.lines import Lines


def band(lower: Tensor, upper: Tensor) -> Band:
    """Band of ``|x|`` on ``[lower, upper]``."""
    return leaky_relu.band(lower, upper, -1.0)


def lines(lower: Tensor, upper: Tensor) -> Lines:
    """Lines of ``|x|`` on ``[lower, upper]``."""
    return leaky_relu.lines(lower, upper, -1.0)


def value_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of ``|x|`` on ``[lower, upper]``, exact."""
    nearest = torch.where((lower <= 0) & (upper >= 0), torch.zeros_like(lower), torch.minimum(lower.abs(), upper.abs()))
    unknown = torch.isnan(lower) | torch.isnan(upper)
    most = torch.where(unknown, torch.full_like(lower, torch.inf), torch.maximum(lower.abs(), upper.abs()))
    return torch.where(unknown, torch.zeros_like(nearest), nearest), most
