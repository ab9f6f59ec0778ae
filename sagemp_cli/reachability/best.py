"""Affine arithmetic and CROWN together: the intersection of both, each sharpening the other's intermediate bounds.

The horizon is gone through in windows. In each, a forward affine pass finds relaxations; a backward sweep from there to the start
bounds the inputs of all operations once more; and the pass is repeated with relaxations for the intersected bounds, which the
windows after it build upon. In the end one sweep over all steps bounds the states; every step's box is the intersection of
that and of the forward pass's box. All bounds enclose the same rollouts, so their intersections do.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from sagemp_cli.errors import ConfigError
from sagemp_cli.reachability.affine import Affine, AffineRun
from sagemp_cli.reachability.affine_form import Hints
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
            last = min(first + self.window, loop.horizon)
            before = runs[-1] if runs else None
            hints = None
            for _ in range(self.rounds + 1):
                run = affine.run(
                    loop, start, disturbance, first=first, horizon=last, before=before, keep_steps=True, hints=hints
                )
                ahead = compiled(run.steps)
                if len(hints or ()) < 1 or _ + 1 < self.rounds + 1:
                    hints = self._hints(steps + ahead, run, start, range(first, last))
            runs.append(run)
            steps += ahead
        backward_ = backward_tube(steps, runs, start, rows=self.rows)
        return backward_

    def _hints(self, steps, run, start, targets) -> list[Hints]:
        found = backward(steps, start.radius, targets=targets, inputs=True).inputs
        return [
            [
                None if bounds is None else tuple(x.reshape(r.center.shape) for x in placed(r.center.flatten(len(r.radius.shape)-1), *bounds))
                for r, bounds in zip(after.frame.relaxations, operations, strict=True)
            ]
            for after, operations in zip(run.steps, found, strict=True)
        ]
