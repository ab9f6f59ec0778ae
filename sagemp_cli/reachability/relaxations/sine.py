"""Sine and cosine, on intervals of any width.

With slope ``a`` the excess ``e(x) = sin x - a x`` has its local maxima at ``t + 2 pi k`` and its local minima at
``-t + 2 pi k`` with ``t = acos a``. Their values are linear in ``k``, so of all the extrema inside an interval only
the first and the last can decide, and the band is exact up to rounding on intervals of any width, for any slope.

The slope. Between two inflections the chord is best. Across one, where the graph is S-shaped, the best line is the
tangent drawn from the end farther from the inflection; it touches about half as far on the other side (exactly so for a
cubic), so the chord from that end to there is as good to higher order. Wide intervals go through a search.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations import lines as _lines
from sagemp_cli.reachability.relaxations.band import Band, settled
from sagemp_cli.reachability.relaxations.functions import constant, functions_of, on_tensors
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.reachability.relaxations.pieces import (
    Excess,
    Objective,
    best_slope,
    lower_objective,
    radius_objective,
    upper_objective,
)
from sagemp_cli.sets.rounding import slack

ULPS = 4
"""Margin for torch's and numpy's ``sin, cos, acos, asin``, in ulps of 1; tested against ball arithmetic."""

# an extremum this far outside (in turns) is counted too: its excess exceeds the end's by at most (2 pi slack)^2 / 2
_SLACK = 1e-7
_TWO_PI = 2.0 * math.pi
_NARROW = 0.05  # rad: below, what an inflection costs (a third-order term) is not worth the time
_WIDE = 2.5  # rad: above, the slope is searched
_FAR = 2.0**40  # rad: beyond, rounding of the argument leaves nothing but [-1, 1]
_SURE = 2.0**30  # rad: up to here turns are computed to less than _SLACK, so that no extremum inside is missed


class _Wave(NamedTuple):
    """Sine or cosine: value, derivative, maximum and minimum of the excess at a slope, one inflection."""

    value: Callable[[Tensor], Tensor]
    derivative: Callable[[Tensor], Tensor]
    turns: Callable[[Tensor], tuple[Tensor, Tensor]]
    inflection: float | np.ndarray


def _sine_turns(slope: Tensor) -> tuple[Tensor, Tensor]:
    turn = functions_of(slope).acos(slope)
    return turn, -turn


def _cosine_turns(slope: Tensor) -> tuple[Tensor, Tensor]:
    turn = functions_of(slope).asin(slope)
    return -turn, math.pi + turn


_SINE = _Wave(lambda x: functions_of(x).sin(x), lambda x: functions_of(x).cos(x), _sine_turns, 0.0)
_COSINE = _Wave(lambda x: functions_of(x).cos(x), lambda x: -functions_of(x).sin(x), _cosine_turns, 0.5 * math.pi)


def _both(first: Callable[[Any, Any], Any], second: Callable[[Any, Any], Any]) -> Callable[[Any], Any]:
    """One function for sines and another for cosines, of values ``(..., 2, B, e)``."""

    def function(x: Any) -> Any:
        m = functions_of(x)
        out = first(m, x)
        out[..., 1, :, :] = second(m, x[..., 1, :, :])
        return out

    return function


def _both_turns(slope: Any) -> tuple[Any, Any]:
    m = functions_of(slope)
    turn = m.acos(slope)
    turn[1] = -m.asin(slope[1])
    other = -turn
    other[1] += math.pi
    return turn, other


_BOTH = _Wave(
    _both(lambda m, x: m.sin(x), lambda m, x: m.cos(x)),
    _both(lambda m, x: m.cos(x), lambda m, x: -m.sin(x)),
    _both_turns,
    np.array([_SINE.inflection, _COSINE.inflection])[:, None, None],
)


def sine_band(lower: Tensor, upper: Tensor) -> Band:
    """Band of ``sin`` on ``[lower, upper]``."""
    return _band(_SINE, lower, upper)


def cosine_band(lower: Tensor, upper: Tensor) -> Band:
    """Band of ``cos`` on ``[lower, upper]``."""
    return _band(_COSINE, lower, upper)


def sine_and_cosine_bands(lower: Any, upper: Any) -> tuple[Band, Band]:
    """Bands of ``sin`` on the first and of ``cos`` on the second of two arrays of intervals, ``(2, B, e)``.

    Both at once take as long as one of them.
    """
    slope, offset, radius = _band(_BOTH, lower, upper)
    return Band(slope[0], offset[0], radius[0]), Band(slope[1], offset[1], radius[1])


def sine_lines(lower: Tensor, upper: Tensor) -> Lines:
    """Lines of ``sin`` on ``[lower, upper]``."""
    return _lines_of(_SINE, lower, upper)


def cosine_lines(lower: Tensor, upper: Tensor) -> Lines:
    """Lines of ``cos`` on ``[lower, upper]``."""
    return _lines_of(_COSINE, lower, upper)


def sine_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of ``sin`` on ``[lower, upper]``; [-1, 1] beyond some 10^9 rad."""
    return _range(_SINE, lower, upper)


def cosine_range(lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of ``cos`` on ``[lower, upper]``; [-1, 1] beyond some 10^9 rad."""
    return _range(_COSINE, lower, upper)


def _band(wave: _Wave, lower: Tensor, upper: Tensor) -> Band:
    m = functions_of(lower)
    ends = m.stack([lower, upper])
    values = wave.value(ends)
    width = upper - lower
    bent = (values[0] * values[1] < 0) & (width > _NARROW) | (width > _WIDE)
    if bool(bent.any()):
        slope = _chord(wave, *_shortened(wave, lower, upper))
        wide = width > _WIDE
        if bool(wide.any()):
            slope = m.where(wide, on_tensors(lambda e, v: _searched(wave, e, v, radius_objective), ends, values), slope)
    else:
        slope = _chord(wave, lower, upper)
    tops, bottoms, _ = _extrema(wave, slope, ends, values)
    most, least = m.amax(tops, 0), m.amin(bottoms, 0)
    size = m.amax(abs(ends), 0)
    offset, radius = 0.5 * (most + least), 0.5 * (most - least) + _margin(size)
    if not bool((size <= _FAR).all()):
        far = (size > _FAR) & m.isfinite(lower) & m.isfinite(upper)
        slope, offset, radius = m.where(far, 0.0, slope), m.where(far, 0.0, offset), m.where(far, 1.0, radius)
    return settled(slope, offset, radius)


def _lines_of(wave: _Wave, lower: Tensor, upper: Tensor) -> Lines:
    ends = torch.stack([lower, upper])
    values, middle = wave.value(ends), 0.5 * lower + 0.5 * upper
    slopes = [_chord(wave, lower, upper), wave.derivative(middle)]
    if bool(((values[0] * values[1] < 0) | (upper - lower > _WIDE)).any()):
        slopes += [_searched(wave, ends, values, objective) for objective in (upper_objective, lower_objective)]
    margin = _margin(ends.abs().amax(0))
    best = Lines(*(torch.full_like(lower, fill) for fill in (0.0, -1.0, 0.0, 1.0)))
    for slope in slopes:
        tops, bottoms, _ = _extrema(wave, slope, ends, values)
        best = _lines.choose(best, Lines(slope, bottoms.amin(0) - margin, slope, tops.amax(0) + margin), middle)
    unknown = 0.0 * (lower + upper)  # NaN where an end is not finite
    return _lines.settled(best._replace(upper_offset=best.upper_offset + unknown))


def _range(wave: _Wave, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    m = functions_of(lower)
    ends, zero = m.stack([lower, upper]), m.zeros_like(lower)
    tops, bottoms, _ = _extrema(wave, zero, ends, wave.value(ends))
    near = m.amax(abs(ends), 0) <= _SURE
    margin = _margin(zero)
    return (
        m.where(near, m.clamp(m.amin(bottoms, 0) - margin, min=-1.0), -1.0),
        m.where(near, m.clamp(m.amax(tops, 0) + margin, max=1.0), 1.0),
    )


def _margin(size: Tensor) -> Tensor:
    """What an excess as computed may be off by.

    The values by ULPS ulps of 1, ``slope * x`` and the difference by 4 roundings, and the argument of the extrema by
    a few ulps of x (times ``|slope| <= 1``; the excess is flat there). The rounding of the offset is in it as well.
    """
    return slack(size + 8.0, 16 + 4 * ULPS)


def _chord(wave: _Wave, lower: Tensor, upper: Tensor) -> Tensor:
    """Slope of the chord ``f'(middle) sin(w / 2) / (w / 2)``, without cancellation at any width, in [-1, 1]."""
    sinc = functions_of(lower).sinc
    return wave.derivative(0.5 * lower + 0.5 * upper) * sinc((upper - lower) * (1.0 / _TWO_PI))


def _shortened(wave: _Wave, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """The interval; if an inflection is inside, its shorter side cut to half the longer one's length."""
    m = functions_of(lower)
    middle = 0.5 * lower + 0.5 * upper
    center = wave.inflection + math.pi * m.round((middle - wave.inflection) * (1.0 / math.pi))
    left, right = center - lower, upper - center
    return (
        m.where(left < right, m.maximum(lower, center - 0.5 * right), lower),
        m.where(left < right, upper, m.minimum(upper, center + 0.5 * left)),
    )


def _extrema(wave: _Wave, slope: Tensor, ends: Tensor, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The excess at both ends and the first and last maximum (and minimum) inside, ``(4, ...)`` each; the points.

    Where none is inside, the last two of the four are infinite of the sign that never wins. The place of an extremum
    and its height are taken as constants by autograd: the derivative of an extreme value with respect to the slope is
    minus its place.
    """
    m = functions_of(slope)
    with constant(slope):
        base = m.stack(wave.turns(slope))
        height = m.sqrt((1.0 - slope) * (1.0 + slope))
        turns = (ends[:, None] - base) * (1.0 / _TWO_PI)
        first, last = m.ceil(turns[0] - _SLACK), m.floor(turns[1] + _SLACK)
        outside = first > last
        points = base + _TWO_PI * m.stack([first, last])
    tilted = slope * points
    at_ends = values - slope * ends
    tops = m.where(outside[0], -math.inf, height - tilted[:, 0])
    bottoms = m.where(outside[1], math.inf, -height - tilted[:, 1])
    return m.cat([at_ends, tops]), m.cat([at_ends, bottoms]), points


@torch.no_grad()
def _searched(wave: _Wave, ends: Tensor, values: Tensor, objective: Objective) -> Tensor:
    def evaluate(slope: Tensor) -> Excess:
        tops, bottoms, points = _extrema(wave, slope, ends, values)
        most, least = tops.max(0, keepdim=True), bottoms.min(0, keepdim=True)
        return Excess(
            least.values[0],
            most.values[0],
            torch.cat([ends, points[:, 1]]).gather(0, least.indices)[0],
            torch.cat([ends, points[:, 0]]).gather(0, most.indices)[0],
        )

    return best_slope(evaluate, ends[0], ends[1], values=(values[0], values[1]), objective=objective, steepest=1.0)
