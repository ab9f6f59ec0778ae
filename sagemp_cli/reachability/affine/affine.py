"""Forward affine arithmetic: the default propagator.

The set of states at step k is a zonotope ``c_k + G_k [-1, 1]^M``. Each step is evaluated once on affine forms
(:mod:`sagemp_cli.reachability.affine.compiled.operations`), which gives the affine inclusion ::

    x_{k+1} in c + J_x (x_k - c_k) + J_w (w_k - c_w) + L [-1, 1]^l + [-e, e]

and with it ``G_{k+1} = [J_x G_k, J_w diag(r_w), L, diag(e)]``. Every error keeps its correlation, which the
feedback then contracts, until it is negligible (:mod:`sagemp_cli.sets.order_reduction`). Rounding is included (last
block), so the tube encloses every real-arithmetic rollout.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.config.ranges import Count
from sagemp_cli.errors import ConfigError, UsageError
from sagemp_cli.reachability.affine.boxed import Boxed
from sagemp_cli.reachability.affine.compiled.checked import Checked, Trace, checked
from sagemp_cli.reachability.affine.compiled.hints import Hints
from sagemp_cli.reachability.affine.compiled.intervals import within
from sagemp_cli.reachability.affine.compiled.run import Done, Steps
from sagemp_cli.reachability.affine.compiled.steps import KeptStep
from sagemp_cli.reachability.affine.halving import Halving
from sagemp_cli.reachability.batch import recorded_and_batched
from sagemp_cli.reachability.program.loops import RecordedLoop
from sagemp_cli.reachability.propagator import NUMBER, Footprint, Loop, LoopSize, Propagator, Reach
from sagemp_cli.reachability.recording import Recording, recorded_bands
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.functions import functions_of
from sagemp_cli.sets import Box, Tube
from sagemp_cli.sets.zonotope import Zonotope

MANY = 2**14
"""Numbers in the generators of all cells from which on it is looked for some to drop at every step."""
SHORT, BLOCK = 8, 128
"""Steps that are taken by forms alone before they are checked against intervals: after some for which they made a
difference, and else, at most."""


@dataclass(frozen=True)
class AffineRun:
    """All that a forward pass found.

    Attributes:
        tube: bounds per step, ``(*batch, K+1, n)``.
        bands: per step, the bands used, in the order of evaluation, of all B cells of the batch, ``(B, E)``.
        kept: per step, the mask of the generators kept, ``(M,)`` or ``(B, M)``.
        steps: per step, what a backward pass needs of it; empty unless asked for.
        watched_lower, watched_upper: bounds of controls and deviations ``(*batch, K, m)``; None unless asked for.
        notes: what whoever reads the tube should know.
        last: the set after the last step, for all B cells.
        halving: what halving the cells would do, followed up to there; None unless asked for.
    """

    tube: Tube
    bands: list[list[tuple[str, Band]]] = field(repr=False)
    kept: list[np.ndarray] = field(default_factory=list, repr=False)
    steps: list[KeptStep] = field(default_factory=list, repr=False)
    watched_lower: Tensor | None = None
    watched_upper: Tensor | None = None
    notes: tuple[str, ...] = ()
    last: Zonotope | None = field(default=None, repr=False)
    halving: Halving | None = field(default=None, repr=False)

    @property
    def alike(self) -> bool:
        """Whether all steps do the same operations, so that what is recorded of them lines up."""
        return len({tuple((name, band.slope.shape[-1:]) for name, band in step) for step in self.bands}) == 1

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
    def reach(self, loop: Loop, start: Box, disturbance: Box, *, watch: bool = False, foresee: bool = False) -> Reach:
        """See :class:`~sagemp_cli.reachability.propagator.Propagator`; with ``foresee`` also what halving cells
        ``(C, n)`` would do.
        """
        strangers = isinstance(loop, RecordedLoop) and any(p.outputs.control is None for p in loop.programs)
        halving = Halving(start) if foresee else None
        run = self.run(loop, start, disturbance, watch=watch and not strangers, halving=halving)
        recording = run.recording() if watch and run.alike else None
        halves = None if run.halving is None else run.halving.halves(loop.horizon)
        lower, upper = run.watched_lower, run.watched_upper
        if lower is None or upper is None:
            return Reach(run.tube, recording=recording, notes=run.notes, halves=halves)
        bad = torch.isnan(lower) | torch.isnan(upper)
        lower, upper = torch.where(bad, -math.inf, lower), torch.where(bad, math.inf, upper)
        return Reach(run.tube, lower, upper, recording, run.notes, halves=halves)

    def footprint(self, size: LoopSize) -> Footprint:
        """Of M generators at the last step, as many as if none were negligible: ``6 M n + 12 v^2`` numbers, ``10 v``
        for each step of a block that is checked against intervals, and twice what is kept, which is bounds, ``3 K E``
        numbers of the recording and a bit per generator and step.
        """
        v, steps = size.variables, size.steps
        generators = size.states + steps * v  # a step adds disturbances, relaxations, a column of rounding per state
        if self.symbols is not None:
            generators = min(generators, max(self.symbols, size.states + 1) + v)
        kept = size.bounds + 3 * steps * size.entries + steps * generators / 64
        working = generators * 6 * size.states + 12 * v**2 + 10 * v * min(BLOCK, steps) + 2 * kept
        return Footprint(NUMBER * working, NUMBER * kept)

    @np.errstate(all="ignore")  # what overflows has infinite bounds
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
        states: Zonotope | None = None,
        intervals: bool = True,
        halving: Halving | None = None,
    ) -> AffineRun:
        """Propagate, and keep what else is asked for; differentiable where autograd is on and something wants it.

        Args:
            loop, start, disturbance: see :class:`~sagemp_cli.reachability.propagator.Propagator`; or of the disturbance
                one box for each step and cell of the batch, ``(K, B, d)``.
            horizon: steps; the loop's by default.
            keep_steps: keep every step, for a backward pass.
            hints: per step, bounds of the operations' inputs that are known to hold; each is intersected with its own.
            watch: bound the controls, and the deviations of a learned robot that is compared with its model.
            states: the set to begin with, of arrays, for all B cells, where that is more than its box ``start``.
            intervals: whether values have an interval beside their form, where nothing is differentiated.
            halving: of cells ``(B, n)``, followed from here on (a copy is), where nothing is differentiated.

        Raises:
            UsageError: a loop that is to be watched does not say what its controls are.
        """
        known, start = recorded_and_batched(loop, start, disturbance, varying=True)
        if watch and any(p.outputs.control is None for p in known.programs):
            raise UsageError(f"{type(loop).__name__} has a step of its own, which does not say what its controls are")
        differentiated = torch.is_grad_enabled() and _wants_gradient(known, start, disturbance)
        batch, n = start.lower.shape[:-1], start.dim
        whole = Zonotope(start.center.reshape(-1, n), torch.diag_embed(start.radius.reshape(-1, n)))
        if states is None:
            states = whole if differentiated else Zonotope(whole.center.numpy(), whole.generators.numpy())
        sides = start.lower.reshape(-1, n), start.upper.reshape(-1, n)
        low, high = sides if differentiated else (side.numpy() for side in sides)
        steps = Steps(known, disturbance, batch, tensors=differentiated, watch=watch)
        course = _Course(states, low, high, Boxed(self.symbols), halving)
        count = loop.horizon if horizon is None else horizon
        asked = _Asked(self.symbols, keep_steps, hints)
        if intervals and not differentiated:
            course = _beside_intervals(steps, course, count, asked, watch=watch)
        else:
            for k in range(count):
                course.take(steps.kept(k, *course.sets, asked.hint(k)), asked)
        tube = Tube(
            *(
                torch.cat([f[..., None, :], _in_batch(s, batch)], -2)
                for f, s in ((start.lower, course.lows), (start.upper, course.highs))
            )
        )
        low, high = [_in_batch(side, batch) for side in zip(*course.controls, strict=True)] or (None, None)
        return AffineRun(
            tube,
            course.bands,
            course.masks,
            course.kept,
            low,
            high,
            course.boxed.notes(),
            course.states,
            course.halving,
        )


class _Asked(NamedTuple):
    """What is asked of a pass: see :class:`Affine`."""

    symbols: int | None
    keep_steps: bool
    hints: Sequence[Hints] | None

    def hint(self, k: int) -> Hints | None:
        """What is known of step k."""
        return None if self.hints is None else self.hints[k]


def _beside_intervals(steps: Steps, course: _Course, count: int, asked: _Asked, *, watch: bool) -> _Course:
    """Take steps up to that one.

    Every value has an interval beside its form, wherever that can make a difference. In the first step it often does,
    and in the one after a step in which it did; there intervals are carried along. Other steps are taken many at once
    without, and checked against intervals afterwards (:mod:`.affine.compiled.checked`).
    """
    beside, length = True, BLOCK
    while course.step < count:
        if beside:
            done = steps.beside_intervals(course.step, *course.sets, asked.hint(course.step))
            course.take(done, asked)
            beside, length = done.used, SHORT if done.used else length
            continue
        before = course.copy()
        traces = [course.traced(steps, asked)]
        while len(traces) < length and course.step < count and not traces[-1].lost:
            traces.append(course.traced(steps, asked))
        found = checked(steps, before.step, traces, watch=watch)
        if found.steps < len(traces):
            course, beside = before, True
            for _ in range(found.steps):
                course.traced(steps, asked)
        course.sharpen(found)
        length = BLOCK
    return course


@dataclass
class _Course:
    """How far a pass has come.

    Attributes:
        states: the set that was reached.
        low, high: its bounds, which may be tighter, ``(B, n)``.
        boxed: what boxing cost.
        halving: what halving the cells would do, if it is asked for.
        again: number of generators from which on it is looked for some to drop.
        lows, highs, bands, masks, controls, kept: of the steps taken.
    """

    states: Zonotope
    low: Any
    high: Any
    boxed: Boxed
    halving: Halving | None = None
    again: int = 0
    lows: list[Any] = field(default_factory=list)
    highs: list[Any] = field(default_factory=list)
    bands: list[list[tuple[str, Band]]] = field(default_factory=list)
    masks: list[np.ndarray] = field(default_factory=list)
    controls: list[tuple[Any, Any]] = field(default_factory=list)
    kept: list[KeptStep] = field(default_factory=list)

    @property
    def step(self) -> int:
        """Which one is next."""
        return len(self.lows)

    @property
    def sets(self) -> tuple[Zonotope, tuple[Any, Any]]:
        """The set that was reached, and its bounds."""
        return self.states, (self.low, self.high)

    def copy(self) -> _Course:
        """One that does not change with this."""
        lists = {name: list(value) for name, value in vars(self).items() if isinstance(value, list)}
        halving = None if self.halving is None else self.halving.copy()
        return dataclasses.replace(self, boxed=copy.copy(self.boxed), halving=halving, **lists)

    def traced(self, steps: Steps, asked: _Asked) -> Trace:
        """Take the next step by forms alone; what is to be kept of it until it is checked."""
        before, k = (self.low, self.high), self.step
        done = steps.by_forms(k, self.states, asked.hint(k))
        self.take(done, asked)
        return Trace(before, done.operands, (self.low, self.high), done.lost is not None)

    def take(self, done: Done, asked: _Asked) -> None:
        """A step."""
        frame, after, states, symbols = done.frame, done.after, done.states, asked.symbols
        self.bands.append(
            [pair for r in frame.relaxed for pair in recorded_bands(r.name, r.band, r.turn, r.ratio, r.given)]
        )
        if done.watched is not None:
            self.controls.append(done.watched)
        if asked.keep_steps:
            self.kept.append(KeptStep.of(frame, after))
        if self.halving is not None:
            self.halving.follow(frame, after)
        mask, added = None, self.states.order
        # To look at all generators costs as much as a step: only when there are a good deal more than before. To look
        # at those that the step added costs little, but more than small ones are worth.
        if states.order > (self.again if symbols is None else max(symbols, states.dim + 1)):
            states, mask = states.reduce_order(symbols)
            self.again = max(states.order * 5 // 4, states.order + 64)
        elif symbols is None and isinstance(states.center, np.ndarray) and states.generators.size > MANY:
            states, mask = states.reduce_order(since=added)
        mask = np.ones(done.states.order, dtype=bool) if mask is None else mask
        self.masks.append(mask)
        if symbols is not None:
            every = done.states.generators
            self.boxed.follow(every if isinstance(every, np.ndarray) else every.detach(), mask)
        self.low, self.high = done.low, done.high
        self.states, bad = states.settled()
        if bad is not None:  # what intervals know of them, if anything
            m = functions_of(bad)
            self.low = m.where(m.isnan(self.low), -math.inf, self.low)
            self.high = m.where(m.isnan(self.high), math.inf, self.high)
        self.lows.append(self.low)
        self.highs.append(self.high)

    def sharpen(self, found: Checked) -> None:
        """What intervals know of the last steps."""
        first = self.step - found.steps
        for i, (low, high) in enumerate(found.rows, start=first):
            self.lows[i], self.highs[i] = self.low, self.high = low, high
        for i, watched in enumerate(found.watched, start=first):
            self.controls[i] = within(self.controls[i], watched)


def _in_batch(steps: Sequence[Any], batch: torch.Size) -> Tensor:
    """Arrays or tensors ``(B, e)`` per step as one tensor ``(*batch, K, e)``."""
    stacked = functions_of(steps[0]).stack(steps)
    whole = stacked if isinstance(stacked, Tensor) else torch.from_numpy(stacked)
    return whole.movedim(0, 1).reshape(*batch, len(steps), whole.shape[-1])


def _wants_gradient(loop: RecordedLoop, *boxes: Box) -> bool:
    """Whether a gradient may be asked for of what these give."""
    constants = [c for p in loop.programs for i in p.instructions for c in i.constants]
    sides = [side for box in boxes for side in (box.lower, box.upper)]
    return any(t.requires_grad for t in (loop.numbers, *constants, *sides))
