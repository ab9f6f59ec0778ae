"""CROWN: linear bounds of every step's state, taken back to the start box.

The relaxations are those of one forward affine pass (:mod:`.affine.affine`), which bounds the inputs of
all operations; then one backward sweep (:mod:`.crown.backward`) serves all steps. Unlike CROWN on the
unrolled graph it does not walk back for every intermediate bound, which costs K^2 visits of every operation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from sagemp_cli.errors import ConfigError
from sagemp_cli.reachability.affine.affine import Affine, AffineRun
from sagemp_cli.reachability.affine.form import Hint, Hints, Relaxed, StepFrame
from sagemp_cli.reachability.batch import batched_start
from sagemp_cli.reachability.crown.backward import backward
from sagemp_cli.reachability.crown.backward_steps import compiled
from sagemp_cli.reachability.propagator import Loop
from sagemp_cli.sets import Box, Tube
from sagemp_cli.sets.rounding import UNIT


@dataclass(frozen=True)
class Crown:
    """Backward linear bounds, rounding included.

    Memory per cell, in float64 numbers: of the order of ``3 K v^2`` for the recorded steps, with v variables a
    step (states, disturbances, one per relaxed entry), and ``5 v rows`` for the sweep.

    Attributes:
        symbols: most generators that the forward pass keeps between steps (None: all).
        rows: most rows that go back at once for one cell; more targets than that take several sweeps.
    """

    symbols: int | None = None
    rows: int = 8192
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
        return taken_back(run, start, rows=self.rows)[0]


def taken_back(run: AffineRun, start: Box, *, rows: int, inputs: bool = False) -> tuple[Tube, list[Hints]]:
    """The tube of backward sweeps over a run's steps; and bounds of all operations' inputs, if asked for.

    Args:
        run: with its steps kept.
        start: in the run's batch shape.
        rows: most rows at once for one cell; at least one step's are taken.
        inputs: whether the operations' inputs are bounded too.
    """
    steps = compiled(run.steps)
    joining = 2 * start.dim
    if inputs:
        joining += max(sum(r.inputs.rows.shape[-1] for r in s.replacements if r.inputs is not None) for s in steps)
    size = max(1, rows // joining)
    lowers, uppers, hints = [start.lower[..., None, :]], [start.upper[..., None, :]], []
    for first in range(0, len(steps), size):
        some = run.steps[first : first + size]
        found = backward(steps, start.radius, targets=range(first, first + len(some)), inputs=inputs)
        lower, upper = _placed(torch.stack([after.center for after in some], dim=-2), *found.state)
        lowers.append(lower)
        uppers.append(upper)
        for after, bounds in zip(some, found.inputs, strict=True):
            hints.append([_hint(after.frame, *pair) for pair in zip(after.frame.relaxations, bounds, strict=True)])
    return Tube(torch.cat(lowers, dim=-2), torch.cat(uppers, dim=-2)), hints


def _hint(frame: StepFrame, operation: Relaxed, bounds: tuple[Tensor, Tensor] | None) -> Hint:
    """What is known of an operation, bounds of its input in its own shape."""
    hint = Hint(operation.name, frame.entries(operation.center.shape), turn=operation.turn)
    if bounds is None:
        return hint
    low, high = _placed(operation.center, *(side.reshape(operation.center.shape) for side in bounds))
    return hint._replace(lower=low, upper=high)


def _placed(center: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of deviations as bounds of values, rounded outwards; infinite where there is no centre."""
    lower = center + low - (center.abs() + low.abs()) * (2 * UNIT)
    upper = center + high + (center.abs() + high.abs()) * (2 * UNIT)
    return torch.nan_to_num(lower, nan=-math.inf), torch.nan_to_num(upper, nan=math.inf)
