"""Interval arithmetic: a box after every step. The simplest propagator, and the loosest.

It forgets how coordinates hang together, so even a contracting loop's boxes usually grow: a baseline, and a second
opinion on single steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch

import sagemp_cli.reachability.relaxations.registry  # noqa: F401  (registers the functions)
from sagemp_cli.reachability.batch import batched_start
from sagemp_cli.reachability.interval.form import IntervalForm
from sagemp_cli.reachability.propagator import NUMBER, Footprint, Loop, LoopSize, Propagator, Reach
from sagemp_cli.sets import Box, Tube


@dataclass(frozen=True)
class Interval(Propagator):
    """One step at a time on boxes, every operation rounded outwards. Memory: the tube and one step's values."""

    name: ClassVar[str] = "interval"
    rigorous: ClassVar[bool] = True

    @torch.no_grad()
    def reach(self, loop: Loop, start: Box, disturbance: Box, *, watch: bool = False) -> Reach:
        """See :class:`~sagemp_cli.reachability.propagator.Propagator`; controls and recordings it has none."""
        start = batched_start(loop, start, disturbance)
        w_shape = (*start.lower.shape[:-1], disturbance.dim)
        w = IntervalForm(disturbance.lower.expand(w_shape), disturbance.upper.expand(w_shape))
        lowers, uppers = [start.lower], [start.upper]
        for k in range(loop.horizon):
            lower, upper = loop.step(k, IntervalForm(lowers[-1], uppers[-1]), w).bounds()
            lowers.append(lower)
            uppers.append(upper)
        return Reach(Tube(torch.stack(lowers, dim=-2), torch.stack(uppers, dim=-2)))

    def footprint(self, size: LoopSize) -> Footprint:
        """``40 v`` numbers for a step, and twice what is kept."""
        kept = NUMBER * size.bounds
        return Footprint(NUMBER * 40 * size.variables + 2 * kept, kept)
