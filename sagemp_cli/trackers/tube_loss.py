"""Reachability-aware training: the width of a differentiable reach tube as a loss.

The tube comes from the same forward affine arithmetic that verifies, on a few references and cells per step, with
few generators, and the radius of the sets annealed from small to full: a full-size tube of an untrained tracker
explodes and its gradient says nothing. In continuous time it is the tube of the Taylor polynomials without their
remainders, which are small: a loss proves nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.config.ranges import Count, NonNegative, Part, Positive
from sagemp_cli.errors import ConfigError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.loop.controller import Controller
from sagemp_cli.problem import Problem
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.continuous.reach import polynomial_steps
from sagemp_cli.sets import Box

WIDEST = 1e6
"""Width from which on a tube counts as exploded, in any unit; its gradient says nothing any more."""


@dataclass(frozen=True)
class TubeLoss:
    """``weight * mean over steps and states of log(1 + width / scale)`` of affine tubes of sampled cells.

    The logarithm keeps one exploding coordinate from drowning the others; every coordinate is weighed by its scale,
    and the end of the horizon counts as much as ``end`` says.

    Attributes:
        weight: of this part in the loss.
        references: references per gradient step.
        counts: uniform partition per uncertain start dimension that training aims at.
        steps: horizon of the tube (at most K).
        symbols: generators kept between steps.
        scale: width per state that counts as one unit.
        end: extra weight of the last step.
        shrink: share of the full radius at the start of annealing.
    """

    weight: NonNegative = 0.3
    references: Count = 6
    counts: Sequence[Count] = (2, 2)
    steps: Count = 60
    symbols: Count = 50
    scale: Sequence[Positive] | Positive = 0.1
    end: NonNegative = 1.0
    shrink: Part = 0.15

    def __post_init__(self) -> None:
        if not 0 < self.shrink <= 1:
            raise ConfigError(f"tracker_training.tube.shrink must lie in (0, 1], found {self.shrink}")

    def __call__(
        self,
        tracker: Controller,
        problem: Problem,
        *,
        references: Tensor,
        share: float,
        generator: torch.Generator,
    ) -> tuple[Tensor, dict[str, float]]:
        """The loss at ``share`` (0..1) of the annealing, and its figures."""
        size = min(1.0, self.shrink + (1.0 - self.shrink) * share / 0.7)
        chosen = torch.randint(references.shape[0], (self.references,), generator=generator)
        cells = self._cells(problem.start, size, generator)
        loop = ClosedLoop(problem.dynamics, tracker, references[chosen])
        around = references[chosen, 0]
        box = Box(around + cells.lower, around + cells.upper)
        w = Box(problem.disturbance.lower * size, problem.disturbance.upper * size)
        steps = min(self.steps, loop.horizon)
        bounded, w = (polynomial_steps(loop, box, w)) if loop.continuous else (loop, w)
        width = Affine(symbols=self.symbols).run(bounded, box, w, horizon=steps).tube.width[:, 1:]
        fits = (width.detach() <= WIDEST).all(-1).all(0)
        if not bool(fits.all()):
            # The gradient of a tube that overflows is NaN, also at the steps before: only those are run again.
            last = max(1, int((~fits).nonzero()[0]))
            width = Affine(symbols=self.symbols).run(bounded, box, w, horizon=last).tube.width[:, 1:]
            width = torch.cat([width, width.new_full((width.shape[0], steps - last, width.shape[-1]), WIDEST)], dim=1)
        scale = torch.as_tensor(self.scale, dtype=torch.float64)
        cost = torch.log1p(width.clamp(max=WIDEST) / scale)
        value = cost.mean() + self.end * cost[:, -1].mean()
        return self.weight * value, {"width": float(width[:, -1].detach().clamp(max=1e9).mean()), "size": size}

    def _cells(self, start: Box, size: float, generator: torch.Generator) -> Box:
        """One random cell of the scaled start set per reference, relative to its centre."""
        radius = start.radius * size
        counts = torch.ones(start.dim, dtype=torch.long)
        uncertain = (start.radius > 0).nonzero()[:, 0]
        for dim, count in zip(uncertain, self.counts, strict=False):
            counts[dim] = count
        cell = torch.stack([torch.randint(int(c), (self.references,), generator=generator) for c in counts], -1)
        width = 2 * radius / counts
        return Box(-radius + cell * width, -radius + (cell + 1) * width)
