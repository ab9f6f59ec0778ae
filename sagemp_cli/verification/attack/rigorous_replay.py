"""A rollout replayed in rigorous arithmetic: what it certainly breaks, whatever float64 makes of it.

Far from the origin, and where a claim is missed by a hair, the rounding of a rollout in float64 is larger than the
violation that it shows. So a rollout refutes a claim only if affine arithmetic, which encloses every rounding error
and lets the feedback contract it, puts the whole state at some time outside of what is claimed: at a sample, or at a
fraction s of a step, where the state is ``(1 - s) x_k + s x_{k+1}``, with s a number that is exact.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor

from sagemp_cli.problem import Problem
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.continuous.reach import reach_continuously
from sagemp_cli.reachability.continuous.sampled import Sampled, sampled
from sagemp_cli.reachability.propagator import Loop
from sagemp_cli.sets import Between, Box, Bulge, Tube, round_down, round_up
from sagemp_cli.sets.between import at_fraction, exact_fraction


@dataclass(frozen=True)
class OneRollout:
    """A loop under one sequence of disturbances ``(K, d)``; the disturbance that a step is given is left aside."""

    loop: Loop
    disturbances: Tensor

    @property
    def horizon(self) -> int:
        """Number of steps K."""
        return self.loop.horizon

    @property
    def state_dim(self) -> int:
        """Number of states n."""
        return self.loop.state_dim

    def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
        """``x_{k+1}`` under the disturbance of step k."""
        return self.loop.step(k, x, self.disturbances[k])


def inner(box: Box) -> Box:
    """What a box certainly holds of the real one whose corners were rounded outwards to make it.

    Rounding to nearest and one float outwards (:meth:`~sagemp_cli.sets.box.Box.around`) moves a corner by less than
    two floats. A dimension that is narrower than that, where nothing is certain, is left as it is.
    """
    low, high = round_up(round_up(box.lower)), round_down(round_down(box.upper))
    fits = low <= high
    return Box(torch.where(fits, low, box.lower), torch.where(fits, high, box.upper))


@dataclass(frozen=True)
class Replay:
    """One rollout enclosed.

    Attributes:
        problem: what is claimed, with X_I ``(n,)``.
        tube: around its states, ``(K+1, n)``; None if nothing is certain of it.
        lines: in continuous time, around its states at S parts of every period, ``(K S + 1, n)``, and how far it leaves
            the straight lines between them.
    """

    problem: Problem
    tube: Tube | None
    lines: tuple[Tube, Bulge] | None = None

    @classmethod
    def of(cls, loop: Loop, start: Tensor, disturbances: Tensor, problem: Problem) -> Replay:
        """Of a start and disturbances.

        Args:
            loop: what steps; may be another one than that of the problem's robot.
            start: ``(n,)``, in :func:`inner` of X_I. In a dimension so narrow that its inner points are not known the
                start is anywhere in it.
            disturbances: ``(K, d)``, in :func:`inner` of W; if W has so narrow a dimension, nothing is certain. Of a
                control that lags with the seconds of delay and jitter of every period.
            problem: what is claimed.
        """
        around, loose = problem.start, _unknown(problem.start)
        if bool(_unknown(problem.unknowns).any()):
            return cls(problem, None)
        first = Box(torch.where(loose, around.lower, start), torch.where(loose, around.upper, start))
        if problem.between is Between.CONTINUOUS:
            return cls._of_solution(cast(Sampled, loop), first, disturbances, problem)
        still = Box.around([0.0] * problem.disturbance.dim, [0.0] * problem.disturbance.dim)
        return cls(problem, Affine().propagate(OneRollout(loop, disturbances), first, still))

    @classmethod
    def _of_solution(cls, loop: Sampled, start: Box, disturbances: Tensor, problem: Problem) -> Replay:
        """In continuous time, with a signal that is constant on every period."""
        cell, n, parts, order = Box(start.lower[None], start.upper[None]), start.dim, None, _ORDER
        w, known = Box(disturbances[:, :n], disturbances[:, :n]), sampled(loop, start)
        if problem.dynamics.control_lag:
            known = dataclasses.replace(known, lag=Box(disturbances[:, n:], disturbances[:, n:]))
            parts, order = _LAG_PARTS, _LAG_ORDER
        found = reach_continuously(Affine(), known, cell, w, substeps=parts, order=order)
        if found.flow is None:
            return cls(problem, None)
        tube = Tube(found.tube.lower[0], found.tube.upper[0])
        fine, bulge = found.flow.lines(found.tube, w, loop.period)
        bulge = Bulge(*(part[0] if part.dim() > 2 else part for part in (bulge.curve, bulge.swing, bulge.rest)))
        return cls(problem, tube, (Tube(fine.lower[0], fine.upper[0]), bulge))

    def broken(self, fractions: Tensor) -> Tensor:
        """Which constraint is certainly broken at which step, ``(K+1, C)``: [workspace, obstacles..., goal].

        Row k is at the given fraction of the line from ``x_k`` to ``x_{k+1}``, or at ``x_k`` if the problem asks for
        the samples only; nothing but the goal is broken in the last row of lines.

        Args:
            fractions: where to look, in [0, 1], for each constraint but the goal, ``(K, C - 1)``.
        """
        steps, columns = fractions.shape
        out = torch.zeros(steps + 1, columns + 1, dtype=torch.bool)
        if self.tube is None:
            return out
        goal, tube = self.problem.scene.goal, self.tube
        out[-1, -1] = ((tube.lower[-1] > goal.upper) | (tube.upper[-1] < goal.lower)).any()
        places = self._places(tube)
        for c in range(columns):
            if self.problem.between is Between.SAMPLES:
                out[:, c] = self._breaks(c, Box(places.lower, places.upper))
            else:
                out[:-1, c] = self._breaks(c, self._at(torch.arange(steps), fractions[:, c]))
        return out

    def _at(self, step: Tensor, fraction: Tensor) -> Box:
        """Boxes ``(k, d)`` around the positions at fractions ``(k,)`` of steps ``(k,)``."""
        assert self.tube is not None
        tube, bulge = (self.tube, None) if self.lines is None else self.lines
        parts = tube.horizon // self.tube.horizon
        part = (fraction * parts).floor().clamp(max=parts - 1)
        row, s = step * parts + part.long(), exact_fraction(fraction * parts - part)
        places = self._places(tube)
        ends = [torch.stack([side[row], side[row + 1]], -2) for side in (places.lower, places.upper)]
        found = at_fraction(Tube(*ends), s[:, None])
        low, high = found.lower[:, 0], found.upper[:, 0]
        if bulge is not None:
            index = list(self.problem.dynamics.position)
            curve, swing, rest = (part[row][:, index] for part in (bulge.curve, bulge.swing, bulge.rest))
            off = round_up(round_up(round_up((s * (1 - s))[:, None] * round_up(curve + swing))) + rest)
            low, high = round_down(low - off), round_up(high + off)
        return Box(low, high)

    def first(self, step: int, constraint: int, fraction: float) -> float:
        """The earliest fraction of a step that is found at which a constraint is certainly broken.

        Along a line an obstacle that is convex, or all that is outside of a workspace that begins inside, is entered
        once: halving from the begin finds where.

        Args:
            step, constraint: which :meth:`broken` says is.
            fraction: at which it is.
        """
        at = torch.tensor([step])
        begin, end = 0.0, float(exact_fraction(torch.tensor(fraction, dtype=torch.float64)))
        for s in (begin, *[None] * _HALVINGS):
            middle = exact_fraction(torch.tensor([0.5 * (begin + end) if s is None else s], dtype=torch.float64))
            if bool(self._breaks(constraint, self._at(at, middle))):
                end = float(middle)
            else:
                begin = float(middle)
        return end

    def _places(self, tube: Tube) -> Tube:
        index = list(self.problem.dynamics.position)
        return Tube(tube.lower[..., index], tube.upper[..., index])

    def _breaks(self, constraint: int, p: Box) -> Tensor:
        """Whether all of position boxes ``(..., d)`` certainly breaks the workspace (0) or an obstacle (1, ...)."""
        scene = self.problem.scene
        if constraint:
            return scene.obstacles[constraint - 1].occupies(p)
        return ((p.lower > scene.workspace.upper) | (p.upper < scene.workspace.lower)).any(-1)


_HALVINGS = 25
_ORDER = 5
"""Degree of the Taylor polynomials, in continuous time: one rollout costs little, and is to be known closely."""
_LAG_PARTS, _LAG_ORDER = 4, 3
"""Parts of a period whose control lags, and degree: what is left out where one control follows another falls with the
parts' length, and not with the degree."""


def _unknown(box: Box) -> Tensor:
    """Dimensions that are neither points nor wide enough to have certain inner points."""
    return (box.lower < box.upper) & (round_up(round_up(box.lower)) > round_down(round_down(box.upper)))
