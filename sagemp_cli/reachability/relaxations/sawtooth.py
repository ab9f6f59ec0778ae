"""What is left of a value when whole periods are taken off: remainder, fmod, and an angle less whole turns.

Where a set lies within one period the function is the value less a number. Else a band is the hull of all that may be
left, a constant.

The number of whole periods m in x is exact: ``torch.fmod`` is, and what it takes off is a multiple of m that is rounded
by less than half of one, up to 2^50 of them. Beyond that many nothing but the hull is claimed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations import lines as _lines
from sagemp_cli.reachability.relaxations.band import Band, settled
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.sets.rounding import TINY, gamma, slack

_MOST_PERIODS = 2.0**50
_MOST_TURNS = 1e9
_PI = math.pi * (1 + 2.0**-52)  # the float64 number above pi


def remainder_band(lower: Tensor, upper: Tensor, period: float) -> Band:
    """Band of ``x - m floor(x / m)`` on ``[lower, upper]``, ``m > 0``."""
    return _band(lower, upper, _remainder(lower, upper, period))


def remainder_lines(lower: Tensor, upper: Tensor, period: float) -> Lines:
    """Lines of ``x - m floor(x / m)`` on ``[lower, upper]``, ``m > 0``."""
    return _edges(remainder_band(lower, upper, period))


def remainder_range(lower: Tensor, upper: Tensor, period: float) -> tuple[Tensor, Tensor]:
    """Bounds of ``x - m floor(x / m)`` on ``[lower, upper]``, ``m > 0``."""
    return _range(lower, upper, _remainder(lower, upper, period))


def fmod_band(lower: Tensor, upper: Tensor, period: float) -> Band:
    """Band of ``x - m trunc(x / m)`` on ``[lower, upper]``, ``m > 0``."""
    return _band(lower, upper, _fmod(lower, upper, period))


def fmod_lines(lower: Tensor, upper: Tensor, period: float) -> Lines:
    """Lines of ``x - m trunc(x / m)`` on ``[lower, upper]``, ``m > 0``."""
    return _edges(fmod_band(lower, upper, period))


def fmod_range(lower: Tensor, upper: Tensor, period: float) -> tuple[Tensor, Tensor]:
    """Bounds of ``x - m trunc(x / m)`` on ``[lower, upper]``, ``m > 0``."""
    return _range(lower, upper, _fmod(lower, upper, period))


def wrap_band(lower: Tensor, upper: Tensor) -> Band:
    """Band of the angle in ``(-pi, pi]`` that is x but for whole turns, on ``[lower, upper]``."""
    return _band(lower, upper, _wrap(lower, upper))


def wrap_lines(lower: Tensor, upper: Tensor) -> Lines:
    """Lines of the same."""
    return _edges(wrap_band(lower, upper))


def wrap_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of the same."""
    return _range(lower, upper, _wrap(lower, upper))


def within_a_period(kind: str, lower: Tensor, upper: Tensor, *period: float) -> Tensor:
    """Whether ``remainder``, ``fmod`` or ``wrap`` does not jump between the ends."""
    return {"remainder": _remainder, "fmod": _fmod, "wrap": _wrap}[kind](lower, upper, *period).known


class _Parts(NamedTuple):
    """Of intervals: whether they lie in one period, what is taken off there and that number's error; the hull of all
    that may be left.
    """

    known: Tensor
    off: Tensor
    doubt: Tensor
    least: Tensor
    most: Tensor


def _remainder(lower: Tensor, upper: Tensor, period: float) -> _Parts:
    (first, known), (last, also) = (_truncated(x, period) for x in (lower, upper))
    first, last = (n - (torch.fmod(x, period) < 0).to(n) for n, x in ((first, lower), (last, upper)))
    off, one = first * period, torch.ones_like(lower)
    return _Parts(known & also & (first == last), off, slack(off.abs(), 2), 0.0 * one, period * one)


def _fmod(lower: Tensor, upper: Tensor, period: float) -> _Parts:
    (first, known), (last, also) = (_truncated(x, period) for x in (lower, upper))
    least = torch.where(lower >= -period, lower.clamp(max=0.0), -period)  # also where nothing is known
    most = torch.where(upper <= period, upper.clamp(min=0.0), period)
    off = first * period
    return _Parts(known & also & (first == last), off, slack(off.abs(), 2), least, most)


def _wrap(lower: Tensor, upper: Tensor) -> _Parts:
    turns = torch.round((0.5 * lower + 0.5 * upper) / (2 * math.pi))
    off = turns * (2 * math.pi)
    doubt = slack(off.abs() + 2 * math.pi, 16)  # of off, and of the ends of the period beside it
    known = (turns.abs() < _MOST_TURNS) & (lower - off > -math.pi + doubt) & (upper - off < math.pi - doubt)
    return _Parts(known, off, slack(off.abs(), 4), *(side * torch.ones_like(lower) for side in (-_PI, _PI)))


def _truncated(x: Tensor, period: float) -> tuple[Tensor, Tensor]:
    """``trunc(x / m)``, and whether it is exact."""
    count = torch.round((x - torch.fmod(x, period)) / period)
    return count, count.abs() < _MOST_PERIODS


def _band(lower: Tensor, upper: Tensor, parts: _Parts) -> Band:
    known, off, doubt, least, most = parts
    offset = torch.where(known, -off, 0.5 * (least + most))
    radius = torch.where(known, doubt, 0.5 * (most - least) * (1 + gamma(4)))
    return settled(known.to(lower), offset, radius + 0.0 * (lower + upper))


def _edges(band: Band) -> Lines:
    slope, offset, radius = band
    margin = radius + (slack(offset.abs() + radius, 4) + TINY) * (radius > 0)
    return _lines.settled(Lines(slope, offset - margin, slope, offset + margin))


def _range(lower: Tensor, upper: Tensor, parts: _Parts) -> tuple[Tensor, Tensor]:
    known, off, doubt, least, most = parts
    low, high = lower - off, upper - off
    low, high = low - (doubt + slack(low.abs(), 2)), high + (doubt + slack(high.abs(), 2))
    return torch.where(known, torch.maximum(low, least), least), torch.where(known, torch.minimum(high, most), most)
