"""Affine arithmetic and CROWN together: the intersection of both, each sharpening the other's intermediate bounds.

The horizon is gone through in windows. In each, a forward affine pass finds relaxations; a backward sweep from there to the start
bounds the inputs of all operations once more; and the pass is repeated with relaxations for the intersected bounds, which the
windows after it build upon. In the end one sweep over all steps bounds the states; every step's box is the intersection of
that and of the forward pass's box. All bounds enclose the same rollouts, so their intersections do.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from sagemp_cli.errors import ConfigError
from sagemp_cli.reachability.affine import Affine, AffineRun
from sagemp_cli.reachability.affine_form import Hints, Relaxed
from sagemp_cli.reachability.backward import Step, backward, compiled
from sagemp_cli.reachability.batch import batched_start
from sagemp_cli.reachability.crown import backward_tube, placed
from sagemp_cli.reachability.propagator import Loop
from sagemp_cli.sets import Box, Tube


@dataclass(frozen=True)
class Best:
    """Affine arithmetic and CROWN sharpening each other; rigorous as both are.

    Attributes:
        window: steps that are sharpened together: fewer are tighter where the set is wide, and take longer.
        rounds: how often each window is sharpened.
        symbols: most generators kept between steps (None: all).
        rows: most rows that go back at once for one cell, see :class:`~sagemp_cli.reachability.crown.Crown`.
    """

    window: int = 10
    rounds: int = 1
    symbols: int | None = None
    rows: int = 4096
    name: ClassVar[str] = "best"
    rigorous: ClassVar[bool] = True

    def __post_init__(self) -> None:
        Affine(symbols=self.symbols)
        for key in ("window", "rounds", "rows"):
            if getattr(self, key) < 1:
                raise ConfigError(f"propagator.{key} must be a positive integer, found {getattr(self, key)}")

    @torch.no_grad()
    def propagate(self, loop: Loop, start: Box, disturbance: Box) -> Tube:
        """See :class:`~sagemp_cli.reachability.propagator.Propagator`."""
        start = batched_start(loop, start, disturbance)
        affine = Affine(symbols=self.symbols)
        runs: list[AffineRun] = []
        steps: list[Step] = []
        for first in range(0, loop.horizon, self.window):
            window = range(first, min(first + self.window, loop.horizon))
            before = runs[-1] if runs else None
            hints = None
            for attempt in range(self.rounds + 1):
                run = affine.run(
                    loop,
                    start,
                    disturbance,
                    first=first,
                    horizon=window.stop,
                    before=before,
                    keep_steps=True,
                    hints=hints,
                )
                ahead = compiled(run.steps)
                if attempt < self.rounds:
                    hints = _hints(run, steps + ahead, start, window, self.rows)
            runs.append(run)
            steps += ahead
        found = backward_tube(steps, runs, start, rows=self.rows)
        lower = torch.cat([runs[0].tube.lower[..., :1, :], *(r.tube.lower[..., 1:, :] for r in runs)], dim=-2)
        upper = torch.cat([runs[0].tube.upper[..., :1, :], *(r.tube.upper[..., 1:, :] for r in runs)], dim=-2)
        return Tube(torch.maximum(lower, found.lower), torch.minimum(upper, found.upper))


def _hints(run: AffineRun, steps: list[Step], start: Box, window: range, rows: int) -> list[Hints]:
    """Bounds of all operations' inputs in a window, from a backward sweep through all steps up to its end."""
    per_step = 2 * start.dim + sum(r.input.shape[-2] for r in steps[-1].replacements if r.input is not None)
    size = max(1, rows // per_step)
    found: list[list[tuple[Tensor, Tensor] | None]] = []
    for first in range(window.start, window.stop, size):
        targets = range(first, min(first + size, window.stop))
        found += backward(steps, start.radius, targets=targets, inputs=True).inputs
    return [
        [
            None if bounds is None else _placed_input(operation, bounds)
            for operation, bounds in zip(after.frame.relaxations, operations, strict=True)
        ]
        for after, operations in zip(run.steps, found, strict=True)
    ]


def _placed_input(operation: Relaxed, bounds: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Bounds of an operation's input in its own shape."""
    low, high = (side.reshape(operation.center.shape) for side in bounds)
    return placed(operation.center, low, high)
