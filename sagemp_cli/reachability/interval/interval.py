"""Interval arithmetic: a box after every step. The simplest propagator, and the loosest.

It forgets how coordinates hang together, so even a contracting loop's boxes usually grow: a baseline, and a second
opinion on single steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch

from sagemp_cli.reachability.batch import recorded_and_batched
from sagemp_cli.reachability.interval.form import IntervalForm, evaluate
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
        known, start = recorded_and_batched(loop, start, disturbance)
        w = IntervalForm(disturbance.lower, disturbance.upper)
        lowers, uppers = [start.lower], [start.upper]
        for k in range(known.horizon):
            numbers = IntervalForm(known.numbers[k], known.numbers[k])
            after = known.program(k).run(IntervalForm(lowers[-1], uppers[-1]), w, numbers, evaluate=evaluate).next
            lowers.append(after.lower.expand(start.lower.shape))
            uppers.append(after.upper.expand(start.upper.shape))
        return Reach(Tube(torch.stack(lowers, dim=-2), torch.stack(uppers, dim=-2)))

    def footprint(self, size: LoopSize) -> Footprint:
        """``40 v`` numbers for a step, and twice what is kept."""
        kept = NUMBER * size.bounds
        return Footprint(NUMBER * 40 * size.variables + 2 * kept, kept)
