"""ELU with alpha 1: ``x`` for ``x > 0``, ``exp(x) - 1`` below; convex and smooth."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations import pieces
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.reachability.relaxations.pieces import Curve, Piece
from sagemp_cli.reachability.relaxations.value_range import increasing

ULPS = 4
"""Margin for ``torch.expm1`` and ``torch.exp``, in ulps of the result; tested against ball arithmetic."""


def _value(x: Tensor) -> Tensor:
    return torch.where(x > 0, x, torch.expm1(x.clamp(max=0.0)))


CURVE = Curve(
    _value,
    lambda x: torch.exp(x.clamp(max=0.0)),
    (Piece(-math.inf, math.inf, True, lambda slope, start, end: torch.log(slope.clamp(1e-300, 1.0))),),
    ULPS,
)


def band(lower: Tensor, upper: Tensor) -> Band:
    """Band of ELU on ``[lower, upper]``."""
    return pieces.band(CURVE, lower, upper)


def lines(lower: Tensor, upper: Tensor) -> Lines:
    """Lines of ELU on ``[lower, upper]``."""
    return pieces.lines(CURVE, lower, upper)


def value_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of ELU on ``[lower, upper]``."""
    return increasing(_value, lower, upper, ulps=ULPS)
