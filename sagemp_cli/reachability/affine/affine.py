"""Forward affine arithmetic: the default propagator.

The set of states at step k is a zonotope ``c_k + G_k [-1, 1]^M``. Each step is evaluated once on affine forms
(:mod:`sagemp_cli.reachability.affine.form`), which gives the affine inclusion ::

    x_{k+1} in c + J_x (x_k - c_k) + J_w (w_k - c_w) + L [-1, 1]^l + [-e, e]

and with it ``G_{k+1} = [J_x G_k, J_w diag(r_w), L, diag(e)]``. Every error keeps its correlation, which the
feedback then contracts, until it is negligible (:mod:`sagemp_cli.sets.order_reduction`). Rounding is included (last
block), so the tube encloses every real-arithmetic rollout.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor

import sagemp_cli.reachability.affine.operations  # noqa: F401  (gives the forms their operations)
import sagemp_cli.reachability.relaxations.registry  # noqa: F401  (registers the relaxations)
from sagemp_cli.config.ranges import Count
from sagemp_cli.errors import ConfigError, UsageError
from sagemp_cli.reachability.affine.boxed import Boxed
from sagemp_cli.reachability.affine.compiled.foldable_loop import FoldableLoop, NotFoldable, speaks_for_itself
from sagemp_cli.reachability.affine.compiled.run import planned_run
from sagemp_cli.reachability.affine.form import AffineForm, Hints, StepFrame
from sagemp_cli.reachability.interval.operands import sharper
from sagemp_cli.reachability.propagator import NUMBER, Footprint, Loop, LoopSize, Propagator, Reach
from sagemp_cli.reachability.recording import Recording
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.sets import Box, Tube
from sagemp_cli.sets.order_reduction import reduce_generators
from sagemp_cli.sets.rounding import UNIT


@dataclass(frozen=True)
class AffineRun:
    """All that a forward pass found.

    Attributes:
        tube: bounds per step, ``(*batch, K+1, n)``.
        bands: per step, the bands used, in the order of evaluation.
        kept: per step, the mask of the generators kept, ``(M,)`` or ``(*batch, M)``.
        steps: per step, the form of the next state (and in its frame, what went into it); empty unless asked for.
        controls: per step, bounds of the controls; empty unless asked for.
        notes: what whoever reads the tube should know.
    """

    tube: Tube
    bands: list[list[tuple[str, Band]]] = field(repr=False)
    kept: list[Tensor] = field(default_factory=list, repr=False)
    steps: list[AffineForm] = field(default_factory=list, repr=False)
    controls: list[tuple[Tensor, Tensor]] = field(default_factory=list, repr=False)
    notes: tuple[str, ...] = ()

    def recording(self) -> Recording:
        """What a certificate keeps of the run."""
        return Recording.of(self.bands, self.tube.lower.shape[:-2], self.kept)


@dataclass(frozen=True)
class Affine(Propagator):
    """Forward affine arithmetic, rigorous.

    Attributes:
        symbols: most generators kept between steps (None: all that are not negligible); the others are boxed, soundly.
    """

    symbols: Count | None = None
    name: ClassVar[str] = "affine"
    rigorous: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.symbols is not None and self.symbols < 1:
            raise ConfigError(f"propagator.symbols must be a positive integer or null, found {self.symbols}")

    @torch.no_grad()
    def reach(self, loop: Loop, start: Box, disturbance: Box, *, watch: bool = False) -> Reach:
        """See :class:`~sagemp_cli.reachability.propagator.Propagator`."""
        run = self._fast_run(loop, start, disturbance, watch=watch)
        if not watch:
            return Reach(run.tube, notes=run.notes)
        lower, upper = (torch.stack(side, dim=-2) for side in zip(*run.controls, strict=True))
        bad = torch.isnan(lower) | torch.isnan(upper)
        lower, upper = torch.where(bad, -math.inf, lower), torch.where(bad, math.inf, upper)
        return Reach(run.tube, lower, upper, run.recording(), run.notes)

    def footprint(self, size: LoopSize) -> Footprint:
        """Of M generators at the last step, as many as if none were negligible: ``M (6 n + 3 H) + 12 v^2`` numbers and
        twice what is kept, which is bounds, ``3 K E`` numbers of the recording and a bit per generator and step.
        """
        v, steps = size.variables, size.steps
        generators = size.states + steps * v  # a step adds disturbances, relaxations, a column of rounding per state
        if self.symbols is not None:
            generators = min(generators, max(self.symbols, size.states + 1) + v)
        kept = size.bounds + 3 * steps * size.entries + steps * generators / 64
        working = generators * (6 * size.states + 3 * size.widest) + 12 * v**2 + 2 * kept
        return Footprint(NUMBER * working, NUMBER * kept)

    def _fast_run(self, loop: Loop, start: Box, disturbance: Box, watch: bool = False) -> AffineRun:
        """:meth:`run` without autograd's bookkeeping; the tube is of ordinary tensors."""
        with torch.inference_mode():
            run = self.run(loop, start, disturbance, watch=watch)
        return dataclasses.replace(run, tube=Tube(run.tube.lower.clone(), run.tube.upper.clone()))

    def run(
        self,
        loop: Loop,
        start: Box,
        disturbance: Box,
        *,
        horizon: int | None = None,
        keep_steps: bool = False,
        hints: Sequence[Hints] | None = None,
        watch: bool = False,
    ) -> AffineRun:
        """Propagate and keep the bands (differentiable where autograd is on).

        A loop that can be folded is, where autograd is off: see :mod:`sagemp_cli.reachability.affine.compiled.run`.

        Args:
            loop, start, disturbance: see :class:`~sagemp_cli.reachability.propagator.Propagator`.
            horizon: steps; the loop's by default.
            keep_steps: keep every step's form, for a backward pass.
            hints: per step, bounds of the operations' inputs that are known to hold; each is intersected with its own.
            watch: bound what the loop's ``step_given`` gives beside the next state, usually the controls.
        """
        steps = loop.horizon if horizon is None else horizon
        foldable = isinstance(loop, FoldableLoop) and speaks_for_itself(loop)
        if watch and not foldable:
            raise UsageError(f"{type(loop).__name__} has a step of its own, which does not say what its controls are")
        if foldable and not torch.is_grad_enabled():
            wanted = {"symbols": self.symbols, "hints": hints, "keep_steps": keep_steps, "watch": watch}
            with contextlib.suppress(NotFoldable):
                found = planned_run(loop, start, disturbance, steps, **wanted)
                return AffineRun(found.tube, found.bands, found.kept, found.steps, found.controls, found.notes)
        center, reach = start.center, start.radius
        generators = torch.diag_embed(reach)
        lowers, uppers = [start.lower], [start.upper]
        w_center, w_radius = disturbance.center, disturbance.radius
        bands, masks, kept_steps, controls = [], [], [], []
        boxed = Boxed(self.symbols)
        for k in range(steps):
            known = None if hints is None else hints[k]
            frame = StepFrame(generators, reach, w_radius, hints=known)
            step = functools.partial(_step, loop, k, watch)
            after, watched = step(frame.state(center), frame.disturbance(w_center))
            lost = torch.isfinite(reach).all(-1) & ~torch.isfinite(after.magnitude).all(-1)
            if bool(lost.any()):  # an operation's domain was left: intervals may know better
                known = sharper(step, (lowers[-1], uppers[-1]), disturbance, known, where=lost)
                frame = StepFrame(generators, reach, w_radius, hints=known)
                after, watched = step(frame.state(center), frame.disturbance(w_center))
            if watched is not None:
                controls.append(watched.bounds())
            bands.append(frame.bands)
            center, generators = _advance(after)
            if keep_steps:
                frame.condense()
                kept_steps.append(after)
            every = generators
            generators, mask = reduce_generators(every, self.symbols)
            boxed.follow(every.detach(), mask)
            masks.append(mask)
            growth = 1.0 + 2 * (generators.shape[-1] + 8) * UNIT
            reach = generators.abs().sum(-1) * growth
            spread = reach * (1.0 + 2 * UNIT) + center.abs() * (2 * UNIT)
            lowers.append(center - spread)
            uppers.append(center + spread)
            if not bool(torch.isfinite(reach).all()):
                lowers, uppers, center, generators, reach = _overflow(lowers, uppers, center, generators, reach)
        tube = Tube(torch.stack(lowers, -2), torch.stack(uppers, -2))
        return AffineRun(tube, bands, masks, kept_steps, controls, boxed.notes())


def _step(loop: Loop, k: int, watch: bool, x: Any, w: Any) -> tuple[Any, Any]:
    """The next state, and what the loop gives beside it if that is wanted."""
    return loop.step_given(loop.given(k), x, w) if watch else (loop.step(k, x, w), None)


def _advance(after: AffineForm) -> tuple[Tensor, Tensor]:
    """Centre and generators of the next state set from the step's affine form."""
    return after.center, torch.cat([after.spread(), torch.diag_embed(after.rounding())], dim=-1)


def _overflow(lowers, uppers, center, generators, reach):
    """Give cells that overflowed infinite bounds from here on, and NaN to go on with; other cells are not disturbed."""
    bad = ~torch.isfinite(reach).all(-1, keepdim=True)
    lowers[-1] = torch.where(bad, torch.full_like(lowers[-1], -math.inf), lowers[-1])
    uppers[-1] = torch.where(bad, torch.full_like(uppers[-1], math.inf), uppers[-1])
    return (
        lowers,
        uppers,
        torch.where(bad, torch.full_like(center, math.nan), center),
        torch.where(bad[..., None], torch.full_like(generators, math.nan), generators),
        torch.where(bad, torch.full_like(reach, math.nan), reach),
    )
