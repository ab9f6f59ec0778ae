"""Reciprocal ``1 / x``: the power -1. An interval that holds 0 has no band."""

from __future__ import annotations

from torch import Tensor

from sagemp_cli.reachability.relaxations import power
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.lines import Lines


def band(lower: Tensor, upper: Tensor) -> Band:
    """Band of ``1 / x`` on ``[lower, upper]``."""
    return power.band(lower, upper, -1)


def lines(lower: Tensor, upper: Tensor) -> Lines:
    """Lines of ``1 / x`` on ``[lower, upper]``."""
    return power.lines(lower, upper, -1)


def value_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of ``1 / x`` on ``[lower, upper]``, infinite if 0 is in it."""
    return power.value_range(lower, upper, -1)
