"""CROWN: linear bounds of every step's state, taken back to the start box, within those of a forward pass.

The relaxations are those of one forward affine pass (:mod:`.affine.affine`), which bounds the inputs of
all operations; then one backward sweep (:mod:`.crown.backward`) serves all steps. Unlike CROWN on the
unrolled graph it does not walk back for every intermediate bound, which costs K^2 visits of every operation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.errors import ConfigError
from sagemp_cli.reachability.affine.affine import Affine, AffineRun
from sagemp_cli.reachability.affine.compiled.hints import Hint, Hints
from sagemp_cli.reachability.affine.compiled.operations import Relaxed
from sagemp_cli.reachability.batch import recorded_and_batched
from sagemp_cli.reachability.blocks import in_blocks, some_of
from sagemp_cli.reachability.crown.backward import backward
from sagemp_cli.reachability.crown.backward_steps import LINEAR
from sagemp_cli.reachability.crown.steps import BLOCK, KEPT, MAKING, Steps
from sagemp_cli.reachability.program.loops import RecordedLoop
from sagemp_cli.reachability.propagator import NUMBER, Footprint, Loop, LoopSize, Propagator, Reach
from sagemp_cli.reachability.relaxations.arctangent2 import Turn
from sagemp_cli.sets import Box, Tube
from sagemp_cli.sets.rounding import slack

BACK = 12
"""Steps that the inputs of operations go back, at least: farther hardly sharpens them, and takes as much time again."""

TOGETHER = 4
"""Steps whose inputs go back together."""

AT_ONCE = 2**29
"""Bytes that cells which are bounded together may take; of one cell, if it takes more."""


@dataclass(frozen=True)
class Crown(Propagator):
    """Backward linear bounds, rounding included. Cells are bounded as many at once as :data:`AT_ONCE` allows.

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
    def reach(self, loop: Loop, start: Box, disturbance: Box, *, watch: bool = False) -> Reach:
        """See :class:`~sagemp_cli.reachability.propagator.Propagator`; controls and recordings it has none."""
        known, start = recorded_and_batched(loop, start, disturbance)

        def bounded(some: RecordedLoop, cells: Box) -> Reach:
            run = Affine(symbols=self.symbols).run(some, cells, disturbance, keep_steps=True)
            return Reach(run.tube.intersected(taken_back(run, cells, rows=self.rows)[0]), notes=run.notes)

        return in_blocks(bounded, known, start, at_once=cells_at_once(self, known, start, disturbance))

    def footprint(self, size: LoopSize) -> Footprint:
        """That of the forward pass, with ``2 K (v^2 + 2 n v)`` numbers for its steps; as much of the same made ready
        as is kept so; and ``(2 v + 3 H + 2 n) rows`` for the sweep.
        """
        return taking_back(self.symbols, min(self.rows, 2 * size.steps * size.states), size)


def taking_back(symbols: int | None, rows: int, size: LoopSize) -> Footprint:
    """See :meth:`Crown.footprint`; for so many rows, of one step at least."""
    v, n = size.variables, size.states
    steps, making = 2 * NUMBER * size.steps * (v**2 + 2 * n * v), MAKING * NUMBER * v**2
    ready = min(KEPT, 2 * steps) + min(max(BLOCK, making), size.steps * making)
    sweep = NUMBER * max(rows, 2 * v) * (2 * v + 3 * size.widest + 2 * n)
    forward = Affine(symbols=symbols).footprint(size)
    assert forward.working is not None
    return Footprint(forward.working + steps + ready + sweep, NUMBER * size.bounds)


def cells_at_once(propagator: Propagator, loop: RecordedLoop, start: Box, disturbance: Box) -> int:
    """Cells ``(..., n)`` that are bounded together, so that they take :data:`AT_ONCE` bytes; 1 at least."""
    batch = start.lower.shape[:-1]
    if batch.numel() == 1:
        return 1
    middle = start.center.reshape(-1, start.dim)[:1]
    run = Affine().run(some_of(loop, batch, slice(0, 1)), Box(middle, middle), disturbance, horizon=1)
    size = LoopSize.of(run.recording(), loop.horizon, start.dim, disturbance.dim)
    needed = propagator.footprint(size).working
    assert needed is not None
    return max(1, int(AT_ONCE // needed))


def taken_back(run: AffineRun, start: Box, *, rows: int, inputs: bool = False) -> tuple[Tube, list[Hints]]:
    """The tube of backward sweeps over a run's steps; and bounds of all operations' inputs, if asked for.

    Args:
        run: with its steps kept.
        start: in the run's batch shape.
        rows: most rows at once for one cell; at least one step's are taken.
        inputs: whether the operations' inputs are bounded too.
    """
    steps, n = Steps(run.steps), start.dim
    box = torch.diag_embed(start.radius.reshape(-1, n)).numpy()
    size = max(1, rows // (2 * n))
    lowers, uppers = [start.lower[..., None, :]], [start.upper[..., None, :]]
    for first in range(0, len(steps), size):
        some = run.steps[first : first + size]
        found = backward(steps, box, targets=range(first, first + len(some))).state
        assert found is not None
        centers = torch.from_numpy(np.stack([step.after.both[0] for step in some], axis=1))
        for sides, side in zip((lowers, uppers), _placed(centers, *found), strict=True):
            sides.append(side.reshape(*start.lower.shape[:-1], len(some), n))
    tube = Tube(torch.cat(lowers, dim=-2), torch.cat(uppers, dim=-2))
    return tube, _inputs(steps, run, box, rows) if inputs else []


def _inputs(steps: Steps, run: AffineRun, box: np.ndarray, rows: int) -> list[Hints]:
    """Bounds of all operations' inputs: they go back a few steps, to the sets of the forward pass."""
    size = max(1, min(TOGETHER, rows // max(1, *(extent.inputs for extent in steps.extents))))
    hints: list[Hints] = []
    for first in range(0, len(steps), size):
        some, begin = run.steps[first : first + size], max(0, first - BACK)
        within = run.steps[begin].within if begin else box
        targets = range(first, first + len(some))
        found = backward(steps, within, targets=targets, begin=begin, states=False, inputs=True).inputs
        for step, bounds in zip(some, found, strict=True):
            hints.append([_hint(*pair) for pair in zip(step.relaxed, bounds, strict=True)])
    return hints


def _hint(operation: Relaxed, bounds: tuple[Tensor, Tensor] | None) -> Hint:
    """What is known of an operation, bounds of its input ``(B, E)``."""
    center = torch.from_numpy(operation.form.both[0])
    turn = None if operation.turn is None else Turn(*map(torch.from_numpy, operation.turn))
    hint = Hint(operation.name, operation.radius.shape[-1], turn=turn)
    if bounds is None:
        return hint
    low, high = _placed(center, *(side.reshape(center.shape) for side in bounds))
    # Where a function is linear on its interval the backward pass asks for bounds only if it is not in another cell.
    slope, offset, radius = (torch.from_numpy(part) for part in (*operation.band[:2], operation.radius))
    needless = radius <= LINEAR * (slope.abs() * torch.from_numpy(operation.form.both[1]) + offset.abs())
    return hint._replace(lower=torch.where(needless, -math.inf, low), upper=torch.where(needless, math.inf, high))


def _placed(center: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of deviations as bounds of values, rounded outwards; infinite where there is no centre."""
    lower = center + low - slack(center.abs() + low.abs(), 2)
    upper = center + high + slack(center.abs() + high.abs(), 2)
    return torch.nan_to_num(lower, nan=-math.inf), torch.nan_to_num(upper, nan=math.inf)
