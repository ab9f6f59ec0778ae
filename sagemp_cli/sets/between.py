"""Where the state is between two samples: boxes over parts of every step, from boxes at the samples.

In the discrete model (forward Euler) the robot moves along a straight line within a step: at ``s`` in [0, 1] of step k
it is at ``(1 - s) x_k + s x_{k+1}``. With ``x_k`` in ``B_k`` and ``x_{k+1}`` in ``B_{k+1}`` that lies in
``(1 - s) B_k + s B_{k+1}``, whose faces are linear in s: over a part ``[a, b]`` of the step the lowest lower face and
the highest upper face are at its ends. What leaves the straight line is a :class:`Bulge`; the discrete model has none.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import torch
from torch import Tensor

from sagemp_cli.errors import UsageError
from sagemp_cli.sets.box import Box
from sagemp_cli.sets.rounding import round_down, round_up
from sagemp_cli.sets.tube import Tube

PARTS = 8
"""Parts of a step. Ends of parts are multiples of 1/8, which float64 has exactly. With 8 the certified distances of the
paper's cases are at most 8 mm below those at the samples; one hull of both ends loses up to 57 mm."""

_GRID = 2.0**30
"""Fractions are multiples of ``1 / _GRID``, of which ``1 - s`` is exact too."""


class Between(StrEnum):
    """What a claim says of the time between two samples."""

    SEGMENTS = "segments"
    """The safe set is kept over the whole of every step, along straight lines from sample to sample."""
    CONTINUOUS = "continuous"
    """The safe set is kept at all times, by every solution of an ODE."""
    SAMPLES = "samples"
    """Nothing: the safe set is kept at the samples only."""

    @property
    def words(self) -> str:
        """When the safe set is kept, for verdicts and figures."""
        return {
            Between.SAMPLES: "at the samples only",
            Between.SEGMENTS: "over the whole of every step",
            Between.CONTINUOUS: "at all times",
        }[self]


@dataclass(frozen=True)
class Bulge:
    """How far the state may be from the straight line at ``s`` in [0, 1] of step k, in each state.

    At most ``s (1 - s) (curve_k + swing_k) + rest_k``; nonnegative float64 arrays ``(..., K, n)`` that broadcast
    against a tube's. What is not finite bounds nothing.

    Attributes:
        curve: of a path that bends, ``h^2 / 2 |x''|``.
        swing: of a disturbance that is not constant over the step, ``2 h rad(W)``.
        rest: any other error, all over the step.
    """

    curve: Tensor
    swing: Tensor
    rest: Tensor

    @property
    def known(self) -> Tensor:
        """Where it bounds anything: numbers that are finite and not negative, ``(..., K, n)``."""
        parts = (self.curve, self.swing, self.rest)
        return torch.stack([torch.isfinite(v) & (v >= 0) for v in torch.broadcast_tensors(*parts)]).all(0)


def over_steps(tube: Tube, bulge: Bulge | None = None, *, parts: int = PARTS) -> Box:
    """Boxes ``(..., K, parts, n)`` that contain the state over the part ``[i / parts, (i + 1) / parts]`` of step k.

    Rounded outwards. Both ends of a part belong to it: together they cover all of the time from 0 to K, samples
    included. A state whose bound is not finite (NaN included) at one end of a step is unbounded over the step.

    Args:
        tube: boxes at the samples, ``(..., K+1, n)``.
        bulge: what leaves the straight line; None: nothing does.
        parts: a power of two, of which the ends of parts are exact.
    """
    if parts < 1 or parts & (parts - 1) or parts > _GRID:
        raise UsageError(f"a step is checked in a power of two of parts, found {parts}")
    finite = torch.isfinite(tube.lower) & torch.isfinite(tube.upper)
    known = (finite[..., :-1, :] & finite[..., 1:, :])[..., None, :]
    lower, upper = tube.lower[..., None, :], tube.upper[..., None, :]  # (..., K+1, 1, n)
    first, last = (lower[..., :-1, :, :], upper[..., :-1, :, :]), (lower[..., 1:, :, :], upper[..., 1:, :, :])
    inner = torch.arange(1, parts, dtype=torch.float64)[:, None] / parts
    low = torch.cat([first[0], _mixed(first[0], last[0], inner, round_down), last[0]], dim=-2)
    high = torch.cat([first[1], _mixed(first[1], last[1], inner, round_up), last[1]], dim=-2)
    low = torch.minimum(low[..., :-1, :], low[..., 1:, :])
    high = torch.maximum(high[..., :-1, :], high[..., 1:, :])
    if bulge is not None:
        reach = _reach(bulge, parts)
        known = known & bulge.known[..., None, :] & torch.isfinite(reach)
        low, high = round_down(low - reach), round_up(high + reach)
    return Box(torch.where(known, low, -torch.inf), torch.where(known, high, torch.inf))


def at_fraction(tube: Tube, fraction: Tensor) -> Box:
    """Boxes ``(..., K, n)`` that contain the states at a fraction ``(..., K)`` of each step, on the straight line.

    Args:
        tube: finite boxes at the samples, ``(..., K+1, n)``.
        fraction: in [0, 1], made by :func:`exact_fraction`.
    """
    s = fraction[..., None]
    ends = tuple((side[..., :-1, :], side[..., 1:, :]) for side in (tube.lower, tube.upper))
    low, high = (_mixed(*pair, s, outwards) for pair, outwards in zip(ends, (round_down, round_up), strict=True))
    for whole, place in ((s == 0, 0), (s == 1, 1)):  # there nothing is computed
        low, high = torch.where(whole, ends[0][place], low), torch.where(whole, ends[1][place], high)
    return Box(low, high)


def exact_fraction(fraction: Tensor) -> Tensor:
    """The nearest numbers s of which s and ``1 - s`` are exact."""
    return torch.round(fraction.clamp(0.0, 1.0) * _GRID) / _GRID


def moment(step: int, fraction: float = 0.0, dt: float | None = None) -> str:
    """A time in words: the step with its fraction, and seconds if the time between two samples is known."""
    time = step + fraction
    seconds = "" if dt is None or not math.isfinite(dt) else f", {time * dt:.4g} s"
    return f"step {f'{time:.4f}'.rstrip('0').rstrip('.') if fraction else step}{seconds}"


def _mixed(first: Tensor, last: Tensor, s: Tensor, outwards: Callable[[Tensor], Tensor]) -> Tensor:
    """``(1 - s) first + s last``, every operation rounded outwards; ``1 - s`` is exact."""
    return outwards(outwards((1.0 - s) * first) + outwards(s * last))


def _reach(bulge: Bulge, parts: int) -> Tensor:
    """The most that the bulge is over each part, ``(..., K, parts, n)``, rounded up.

    ``s (1 - s)`` rises up to 1/2, an end of a part (or, of one part only, its middle), and falls from there.
    """
    ends = torch.arange(parts + 1, dtype=torch.float64) / parts
    rise = ends * (1.0 - ends)  # exact: multiples of 1 / parts^2
    most = torch.maximum(rise[:-1], rise[1:]) if parts > 1 else torch.full((1,), 0.25, dtype=torch.float64)
    curve, swing, rest = (value[..., None, :] for value in (bulge.curve, bulge.swing, bulge.rest))
    return round_up(round_up(most[:, None] * round_up(curve + swing)) + rest)
