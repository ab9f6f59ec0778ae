"""Bands and lines of smooth functions that are convex or concave piece by piece.

For a slope ``a`` let ``e(x) = f(x) - a x``. Where f is convex, e is largest at the ends of the piece, and for *any*
point t of it ``e(x) >= e(t) + (f'(t) - a)(x - t)``. So a lower bound needs no certified root: t is where ``f'(t) =
a`` as well as the machine knows, and what is left of ``f'(t) - a`` is paid for. Concave pieces are the same upside
down. Every slope gives a sound band; which one is used decides only how tight it is.

The best slope. The band's radius is a convex function of the slope, and so is the area under the upper line or over
the lower one (each is a maximum of functions linear in the slope). On a single piece the chord is best for the band;
where an interval holds an inflection the minimum is found by cutting planes: each evaluation adds the line that its
extreme points define, and the next slope is where the last lines on either side meet (a Remez exchange).

Bands are made of tensors, and where a curve's own functions are written for both
(:mod:`~sagemp_cli.reachability.relaxations.functions`), of arrays.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations import lines as _lines
from sagemp_cli.reachability.relaxations.band import Band, settled
from sagemp_cli.reachability.relaxations.functions import constant, functions_of, on_tensors
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.sets.rounding import TINY, gamma, slack

_GOOD = 2e-4  # a slope whose objective is this close to the best, in units of the excess's range, is not refined

Objective = Callable[["Excess", Tensor, Tensor], tuple[Tensor, Tensor]]
"""From excess, slope and middle: what is to be minimised and its derivative with respect to the slope."""


class Piece(NamedTuple):
    """Where a function is convex (or concave).

    Attributes:
        start, end: of the piece, numbers or tensors. Where they are inflections they may be off by rounding: the
            curvature there is of that order too, and its effect of second order.
        convex: or concave.
        touch: the point whose derivative is a given slope, as well as it can be had; arguments slope and the ends of
            that part of the piece which lies in the interval. Any number is sound, NaN means the start.
    """

    start: float | Tensor
    end: float | Tensor
    convex: bool
    touch: Callable[[Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Curve:
    """A differentiable function made of convex and concave pieces in alternation.

    Attributes:
        value: ``f``, as computed.
        derivative: ``f'``, as computed.
        pieces: from left to right; together they cover the domain.
        ulps: both are computed to within ``ulps * 2^-52`` of their size.
        floor: error of the value that is not relative to its size.
        derivative_floor: the same for the derivative.
    """

    value: Callable[[Tensor], Tensor]
    derivative: Callable[[Tensor], Tensor]
    pieces: tuple[Piece, ...]
    ulps: float
    floor: float = TINY
    derivative_floor: float = 0.0

    @property
    def margin(self) -> float:
        """Relative error of ``f(x) - a x`` as computed: of f, of the product and of the difference."""
        return gamma(2 * self.ulps + 4)


class Excess(NamedTuple):
    """Bounds of ``f(x) - a x`` over an interval, rounding included, and the points where they are (nearly) attained."""

    least: Tensor
    most: Tensor
    lowest: Tensor
    highest: Tensor


def band(curve: Curve, lower: Tensor, upper: Tensor, *, allowed: Tensor | None = None) -> Band:
    """The band of smallest radius.

    Args:
        curve: the function.
        lower, upper: ends of the intervals.
        allowed: intervals inside the function's domain; elsewhere the band claims nothing.
    """
    lower, upper, outside = _confined(lower, upper, allowed)
    m = functions_of(lower)
    ends = m.stack([lower, upper])
    values = curve.value(ends)
    slope = _chord(curve, ends, values)
    crossing = _crossing(curve, lower, upper)
    if crossing is not None and bool(crossing.any()):
        slope = _where_crossing(curve, crossing, ends, values, radius_objective, slope)
    found = excess(curve, slope, ends, values)
    radius = 0.5 * (found.most - found.least) + slack(abs(found.most) + abs(found.least), 2) + outside
    return settled(slope, 0.5 * (found.most + found.least), radius)


def lines(curve: Curve, lower: Tensor, upper: Tensor, *, allowed: Tensor | None = None) -> Lines:
    """The lines of smallest area: on one piece the chord and the tangent at the middle, else found by search."""
    lower, upper, outside = _confined(lower, upper, allowed)
    ends = torch.stack([lower, upper])
    values, middle = curve.value(ends), 0.5 * lower + 0.5 * upper
    slopes = [_chord(curve, ends, values), curve.derivative(middle)]
    crossing = _crossing(curve, lower, upper)
    if crossing is not None and bool(crossing.any()):
        slopes += [_searched(curve, ends, values, objective) for objective in (upper_objective, lower_objective)]
    best = None
    for slope in slopes:
        found = excess(curve, slope, ends, values)
        pair = Lines(slope, found.least, slope, found.most)
        best = pair if best is None else _lines.choose(best, pair, middle)
    assert best is not None
    return _lines.settled(best._replace(upper_offset=best.upper_offset + outside))


def excess(curve: Curve, slope: Tensor, ends: Tensor, values: Tensor) -> Excess:
    """Sound bounds of ``f(x) - slope x`` between the ends ``(2, ...)``, for any slope; ``values`` are f at the ends."""
    m = functions_of(ends)
    lower, upper = ends[0], ends[1]
    at_ends, error = _tilted(curve, slope, ends, values)
    low, high = at_ends - error, at_ends + error
    least, most = m.amin(low, 0), m.amax(high, 0)
    lowest, highest = m.where(low[0] <= low[1], lower, upper), m.where(high[0] >= high[1], lower, upper)
    for piece in curve.pieces:
        start, end = _part(piece.start, lower, upper), _part(piece.end, lower, upper)
        if len(curve.pieces) > 1 and not bool((start < end).any()):
            continue
        with constant(ends):  # any point of the piece will do
            t = m.minimum(m.fmax(piece.touch(slope, start, end), start), end)
            derivative = curve.derivative(t)
        at_t, error = _tilted(curve, slope, t, curve.value(t))
        tilt = derivative - slope
        left, right = (t - start) * tilt, (t - end) * tilt
        error = error + (end - start) * ((abs(derivative) + abs(slope) + curve.derivative_floor) * curve.margin)
        if piece.convex:
            bound = at_t - error - m.maximum(left, right)
            lowest, least = m.where(bound < least, t, lowest), m.minimum(bound, least)
        else:
            bound = at_t + error - m.minimum(left, right)
            highest, most = m.where(bound > most, t, highest), m.maximum(bound, most)
    return Excess(least, most, lowest, highest)


def _tilted(curve: Curve, slope: Tensor, x: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
    """``f(x) - slope x`` as computed, and a bound of its error."""
    line = slope * x
    return value - line, (abs(value) + abs(line)) * curve.margin + curve.floor


def best_slope(
    evaluate: Callable[[Tensor], Excess],
    lower: Tensor,
    upper: Tensor,
    *,
    values: tuple[Tensor, Tensor],
    objective: Objective,
    steepest: float = math.inf,
    iterations: int = 8,
) -> Tensor:
    """The slope that makes a convex objective smallest, by cutting planes; the first one tried is the chord's.

    Args:
        evaluate: the excess at a slope.
        lower, upper: ends of the intervals.
        values: the function at the ends.
        objective: what to minimise.
        steepest: bound of ``|slope|``.
        iterations: most evaluations.
    """
    middle = 0.5 * lower + 0.5 * upper
    zero = torch.zeros_like(lower)
    # The two planes that the ends alone define: one falls, the other rises with the slope.
    left, left_grade = objective(Excess(*values, lower, upper), zero, middle)
    right, right_grade = objective(Excess(values[1], values[0], upper, lower), zero, middle)
    best, lowest = zero, torch.full_like(lower, math.inf)
    for _ in range(iterations):
        rise = right_grade - left_grade
        slope = torch.where(rise > 0, (left - right) / rise, best).clamp(-steepest, steepest)
        found = evaluate(slope)
        now, grade = objective(found, slope, middle)
        plane, falls, better = now - grade * slope, grade <= 0, now < lowest
        best, lowest = torch.where(better, slope, best), torch.where(better, now, lowest)
        # The planes bound the objective from below, so they say how far from the best this slope can be.
        if bool((now - left - left_grade * slope <= _GOOD * (found.most - found.least)).all()):
            break
        left, left_grade = torch.where(falls, plane, left), torch.where(falls, grade, left_grade)
        right, right_grade = torch.where(falls, right, plane), torch.where(falls, right_grade, grade)
    return best


def _where_crossing(
    curve: Curve, crossing: Tensor, ends: Tensor, values: Tensor, objective: Objective, slope: Tensor
) -> Tensor:
    """The slope, or what is searched where an inflection lies inside, for these intervals alone: a search is dear."""
    m = functions_of(ends)
    if all(isinstance(piece.start, float) for piece in curve.pieces) and not bool(crossing.all()):
        searched = m.zeros_like(slope)
        searched[crossing] = _searched(curve, ends[:, crossing], values[:, crossing], objective)
        return m.where(crossing, searched, slope)
    return m.where(crossing, _searched(curve, ends, values, objective), slope)


@torch.no_grad()
def _searched(curve: Curve, ends: Tensor, values: Tensor, objective: Objective) -> Tensor:
    if not isinstance(ends, Tensor):
        return on_tensors(lambda e, v: _searched(curve, e, v, objective), ends, values)
    return best_slope(
        lambda slope: excess(curve, slope, ends, values),
        ends[0],
        ends[1],
        values=(values[0], values[1]),
        objective=objective,
    )


def radius_objective(found: Excess, slope: Tensor, middle: Tensor) -> tuple[Tensor, Tensor]:
    """Radius of the band with this slope."""
    return 0.5 * (found.most - found.least), 0.5 * (found.lowest - found.highest)


def upper_objective(found: Excess, slope: Tensor, middle: Tensor) -> tuple[Tensor, Tensor]:
    """Height of the upper line at the middle, which orders the areas under it."""
    return found.most + slope * middle, middle - found.highest


def lower_objective(found: Excess, slope: Tensor, middle: Tensor) -> tuple[Tensor, Tensor]:
    """Depth of the lower line at the middle."""
    return -found.least - slope * middle, found.lowest - middle


def _part(boundary: float | Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """A piece's boundary, moved into the interval."""
    if isinstance(boundary, float) and math.isinf(boundary):
        return lower if boundary < 0 else upper
    m = functions_of(lower)
    return m.minimum(m.clamp(lower, min=boundary), upper)


def _crossing(curve: Curve, lower: Tensor, upper: Tensor) -> Tensor | None:
    """Whether an inflection lies inside; None if there is none at all."""
    inside = [(lower < piece.start) & (piece.start < upper) for piece in curve.pieces[1:]]
    return functools.reduce(operator.or_, inside) if inside else None


def _chord(curve: Curve, ends: Tensor, values: Tensor) -> Tensor:
    """Slope of the chord, or where that would be rounding only, of the tangent at the middle."""
    width = ends[1] - ends[0]
    wide = width > 1e-6 * (abs(ends[0]) + abs(ends[1])) + TINY
    rise = values[1] - values[0]
    if bool(wide.all()):
        return rise / width
    m = functions_of(width)
    return m.where(wide, rise / m.where(wide, width, 1.0), curve.derivative(0.5 * ends[0] + 0.5 * ends[1]))


def _confined(lower: Tensor, upper: Tensor, allowed: Tensor | None) -> tuple[Tensor, Tensor, Tensor | float]:
    """Intervals to compute with, 1 where nothing can be said, and what to add to the radius: infinity there."""
    m = functions_of(lower)
    good = m.isfinite(lower) & m.isfinite(upper)
    if allowed is not None:
        good = good & allowed
    if bool(good.all()):
        return lower, upper, 0.0
    zero = m.zeros_like(lower)
    return m.where(good, lower, 1.0), m.where(good, upper, 1.0), m.where(good, zero, zero + math.inf)
