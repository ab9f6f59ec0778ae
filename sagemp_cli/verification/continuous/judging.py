"""What a flow proves of requirements, at all times that they speak of.

Time is cut at the ends of all parts of all periods. A requirement is checked at the ends that its interval holds and
over every part that it touches. Its times are read in periods: one within a millionth of a period of a sample means
that sample.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.errors import UsageError
from sagemp_cli.reachability.continuous.margins import Observable, along, at_boxes, observable
from sagemp_cli.reachability.continuous.sampled import SampledLoop
from sagemp_cli.reachability.propagator import Reach
from sagemp_cli.scenes.requirements import Formula
from sagemp_cli.sets import Box, Tube

_NEAR = 1e-6
"""Share of a period by which a time may differ from a sample that it means."""


@dataclass(frozen=True, eq=False)
class Asked:
    """A formula with its margins as programs.

    Attributes:
        formula: it.
        margins: as programs.
        first, last: when it has to hold, both included, in periods.
    """

    formula: Formula
    margins: Observable
    first: float
    last: float

    @staticmethod
    def of(formula: Formula, loop: SampledLoop, example: Tensor) -> Asked:
        """Recorded.

        Raises:
            UsageError: margins that are none, or times beyond the horizon.
            UnsupportedOperationError: margins that cannot be bounded.
        """
        end = loop.horizon * loop.period
        last = formula.first if math.isinf(formula.last) else formula.last
        if math.isfinite(last) and last > end * (1 + 1e-9):
            raise UsageError(
                f"requirement '{formula.name}' speaks of {last:g} s, the horizon ends at {end:g} s: "
                f"{loop.horizon} periods of {loop.period:g} s"
            )
        margins = observable(formula.margins, loop, example, formula.name)
        first, last = (in_periods(t, loop.period, loop.horizon) for t in (formula.first, formula.last))
        return Asked(formula, margins, first, last)

    def times(self, loop: SampledLoop, substeps: int) -> tuple[Tensor, Tensor]:
        """Which ends of parts ``(K S + 1,)`` and which parts ``(K S,)`` it speaks of; exact, since S is a power of
        two."""
        first, last = self.first * substeps, self.last * substeps
        ends = torch.arange(loop.horizon * substeps + 1, dtype=torch.float64)
        return (first <= ends) & (ends <= last), (first < ends[1:]) & (ends[:-1] < last)

    def worst(self, margins: Tensor) -> Tensor:
        """Of margins ``(..., c)``, the one that decides, ``(...,)``."""
        return margins.amin(-1) if self.formula.every else margins.amax(-1)


def in_periods(time: float, period: float, horizon: int) -> float:
    """A time in periods, the horizon at most; one that is near a sample is that sample."""
    place = time / period
    if math.isfinite(place) and abs(place - round(place)) < _NEAR:
        place = float(round(place))
    return min(place, float(horizon))


@dataclass(frozen=True)
class Judgement:
    """What the flows of C cells prove of R requirements.

    Attributes:
        margin: the least margin that is certain over all times, ``(C, R)``; -inf where nothing is known.
        time: when it is so small, in seconds, ``(C, R)``.
        holds: whether the requirement is proved, ``(C, R)``.
        missing: how much there is missing over all times, 0 if nothing; it guides, it proves nothing, ``(C,)``.
    """

    margin: Tensor
    time: Tensor
    holds: Tensor
    missing: Tensor


def judged(reach: Reach, asked: Sequence[Asked], loop: SampledLoop, w: Box) -> Judgement:
    """Judge flows; a bound that is NaN or infinite proves nothing."""
    flow = reach.flow
    assert flow is not None
    cells, controls = len(flow.lower), _controls(reach, loop, len(flow.lower))
    known = torch.isfinite(reach.tube.lower[:, 1:]) & torch.isfinite(reach.tube.upper[:, 1:])
    known &= (torch.isfinite(flow.lower) & torch.isfinite(flow.upper)).all(2)
    start = torch.isfinite(reach.tube.lower[:, 0]) & torch.isfinite(reach.tube.upper[:, 0])
    lost_periods = (~known.all(-1)).double().mean(1)
    bounded = (lost_periods == 0) & start.all(-1)
    missing = math.log1p(_HUGE) * lost_periods  # so many as there are, so that fewer are better
    rows = []
    h = loop.period / flow.division.substeps
    for one in asked:
        at_ends, over = along(one.margins, loop, flow, reach.tube, controls, w)
        ends, parts = one.times(loop, flow.division.substeps)
        margins = torch.cat([one.worst(at_ends)[:, ends], one.worst(over)[:, parts]], 1)
        margins = torch.nan_to_num(margins, nan=-torch.inf, posinf=torch.inf, neginf=-torch.inf)
        times = torch.cat([ends.nonzero()[:, 0], parts.nonzero()[:, 0]]).double() * h
        holds = one.formula.holds(margins).all(1) & bounded
        # The earliest of the times at which it is not proved; where it is proved, that of the least margin.
        least, where = margins.min(1)
        lost = ~one.formula.holds(margins)
        first = torch.where(lost, times, torch.inf).amin(1)
        rows.append((least, torch.where(lost.any(1), first, times[where]), holds))
        missing = missing + torch.log1p((-margins).clamp(0.0, _HUGE)).mean(1) + lost.double().mean(1)
    nothing = torch.zeros(cells, 0, dtype=torch.float64)
    margin, time = (torch.stack([row[i] for row in rows], 1) if rows else nothing for i in (0, 1))
    holds = torch.stack([row[2] for row in rows], 1) if rows else bounded[:, None]
    return Judgement(margin, time, holds, torch.where(holds.all(1), 0.0, missing))


def foreseen_missing(tube: Tube, asked: Sequence[Asked], loop: SampledLoop) -> Tensor:
    """How much tubes at the instants, and what lies between their boxes, would miss, ``(C,)``; it proves nothing."""
    lower, upper = torch.nan_to_num(tube.lower, nan=-torch.inf), torch.nan_to_num(tube.upper, nan=torch.inf)
    over = torch.minimum(lower[:, 1:], lower[:, :-1]), torch.maximum(upper[:, 1:], upper[:, :-1])
    missing = torch.zeros(len(lower), dtype=torch.float64)
    for one in asked:
        found = zip(one.times(loop, 1), (Box(lower, upper), Box(*over)), strict=True)
        margins = torch.cat([one.worst(at_boxes(one.margins, boxes)[0])[:, when] for when, boxes in found], 1)
        margins = torch.nan_to_num(margins, nan=-_HUGE, neginf=-_HUGE)
        missing = missing + torch.log1p((-margins).clamp(0.0, _HUGE)).mean(1)
    return missing


_HUGE = 1e300


def _controls(reach: Reach, loop: SampledLoop, cells: int) -> tuple[Tensor, Tensor]:
    if reach.control_lower is None or reach.control_upper is None:
        everything = torch.full((cells, loop.horizon, loop.controls), torch.inf, dtype=torch.float64)
        return -everything, everything
    return reach.control_lower, reach.control_upper
