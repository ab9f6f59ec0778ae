"""CROWN: linear bounds of every step's state, taken back to the start box.

The relaxations are those of one forward affine pass (:mod:`sagemp_cli.reachability.affine`), which bounds the inputs of all
operations; then one backward sweep (:mod:`sagemp_cli.reachability.backward`) serves all steps. Unlike CROWN on the unrolled graph
it does not walk back for every intermediate bound, which costs K^2 visits of every operation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from sagemp_cli.errors import ConfigError
from sagemp_cli.reachability.affine import Affine, AffineRun
from sagemp_cli.reachability.backward import Step, backward, compiled
from sagemp_cli.reachability.batch import batched_start
from sagemp_cli.reachability.propagator import Loop
from sagemp_cli.reachability.relaxations.band import UNIT
from sagemp_cli.sets import Box, Tube


@dataclass(frozen=True)
class Crown:
    """Backward linear bounds, rounding included.

    Memory per cell: of the order of ``K (v^2 + v n)`` numbers for the steps, with v variables a step (states, disturbances, one
    per relaxed entry), plus ``rows`` times 5 v for the sweep.

    Attributes:
        symbols: most generators that the forward pass keeps between steps (None: all).
        rows: most rows that go back at once for one cell; more targets than that take several sweeps.
    """

    symbols: int | None = None
    rows: int = 4096
    name: ClassVar[str] = "crown"
    rigorous: ClassVar[bool] = True

    def __post_init__(self) -> None:
        Affine(symbols=self.symbols)
        if self.rows < 1:
            raise ConfigError(f"propagator.rows must be a positive integer, found {self.rows}")

    @torch.no_grad()
    def propagate(self, loop: Loop, start: Box, disturbance: Box) -> Tube:
        """See :class:`~sagemp_cli.reachability.propagator.Propagator`."""
        start = batched_start(loop, start, disturbance)
        run = Affine(symbols=self.symbols).run(loop, start, disturbance, keep_steps=True)
        return backward_tube(compiled(run.steps), [run], start, rows=self.rows)


def backward_tube(steps: list[Step], runs: list[AffineRun], start: Box, *, rows: int) -> Tube:
    """The tube of a backward sweep over the steps of runs that follow one another.

    Args:
        steps: all steps, ready for rows.
        runs: whose centres the rows are relative to.
        start: in the runs' batch shape.
        rows: most rows at once; at least one step's are taken.
    """
    centers = torch.stack([after.center for run in runs for after in run.steps], dim=-2)
    size = max(1, rows // (2 * start.dim))
    sides: tuple[list[Tensor], list[Tensor]] = ([], [])
    for first in range(0, len(steps), size):
        targets = range(first, min(first + size, len(steps)))
        bounds = backward(steps, start.radius, targets=targets)
        for side, found in zip(sides, bounds.state, strict=True):
            side.append(found)
    low, high = (torch.cat(side, dim=-2) for side in sides)
    lower, upper = placed(centers, low, high)
    return Tube(
        torch.cat([start.lower[..., None, :], lower], dim=-2), torch.cat([start.upper[..., None, :], upper], dim=-2)
    )


def placed(center: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of deviations as bounds of values, rounded outwards; infinite where there is no centre."""
    lower = center + low - (center.abs() + low.abs()) * (2 * UNIT)
    upper = center + high + (center.abs() + high.abs()) * (2 * UNIT)
    return torch.nan_to_num(lower, nan=-math.inf), torch.nan_to_num(upper, nan=math.inf)
