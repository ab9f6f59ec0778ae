"""Searches for a solution of an ODE that breaks a requirement; one that is found is proved by the engine itself.

The search is in float64: rollouts by the classical Runge-Kutta method, from corners and random starts and then by
gradient ascent, under disturbances that are constant in time. What it finds is bounded from its start alone: where all
states that the enclosure holds break the requirement, so does the solution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.continuous.margins import at_boxes
from sagemp_cli.reachability.continuous.reach import reach_continuously
from sagemp_cli.reachability.continuous.sampled import SampledLoop
from sagemp_cli.reachability.flow import Division
from sagemp_cli.reachability.propagator import Reach
from sagemp_cli.sets import Box
from sagemp_cli.verification.continuous.judging import Asked

STEPS = 4
"""Runge-Kutta steps in a period; a replay has as many parts."""

ROLLOUTS = 64
"""Of each search."""

_REPLAYS = (Division(1, 2), Division(2, 3), Division(4, 3))
"""How a solution is enclosed, until that proves it a violation."""

_RATES = (0.5, 0.5, 0.25, 0.25, 0.1, 0.1)
"""Shares of the box that an ascent goes in one step."""


@dataclass(frozen=True)
class Violation:
    """A solution that breaks a requirement.

    Attributes:
        start: ``(n,)``.
        disturbance: constant in time, ``(n,)``.
        states: at the ends of all parts, in float64, ``(K S + 1, n)``.
        times: of them, in seconds.
        requirement: its name.
        time: when the enclosure proves it broken first; in float64 where none does.
        depth: how far the margin is below 0 then, in float64.
        proved: whether an enclosure of the solution proves it.
    """

    start: Tensor
    disturbance: Tensor
    states: Tensor
    times: Tensor
    requirement: str
    time: float
    depth: float
    proved: bool


def simulated(loop: SampledLoop, x: Tensor, w: Tensor) -> Tensor:
    """States at the ends of all parts, ``(..., K S + 1, n)``, from starts and constant disturbances ``(..., n)``."""
    h, states = loop.period / STEPS, [x]
    nothing = torch.zeros_like(w)
    for k in range(loop.horizon):
        u = loop.control.run(x, nothing, loop.numbers[k] if loop.numbers.shape[-1] else None).control

        def rate(y: Tensor, u: Tensor = u) -> Tensor:
            return loop.rate.run(y, nothing, u).next + w

        for _ in range(STEPS):
            a = rate(x)
            b = rate(x + h / 2 * a)
            c = rate(x + h / 2 * b)
            d = rate(x + h * c)
            x = x + h / 6 * (a + 2 * b + 2 * c + d)
            states.append(x)
    return torch.stack(states, -2)


def search(
    loop: SampledLoop, start: Box, w: Box, asked: Sequence[Asked], *, generator: torch.Generator, ascents: bool
) -> Violation | None:
    """A violation, proved if any that was tried could be; None if float64 shows none, which proves nothing."""
    if not asked:
        return None
    x, v = _corners(start, generator), _corners(w, generator)
    found = _best(loop, start, w, asked, x, v, None)
    if not ascents or (found is not None and found.proved):
        return found
    target = torch.arange(len(x)) % len(asked)
    for share in _RATES:
        x, v = x.detach().requires_grad_(True), v.detach().requires_grad_(True)
        with torch.enable_grad():
            least = _least(asked, loop, simulated(loop, x, v))
            score = least.gather(1, target[:, None])[:, 0]
            score = score[torch.isfinite(score)].sum()
            if not score.requires_grad:
                break
            slopes = torch.autograd.grad(score, [x, v])
        x, v = (
            _into(box, point.detach() - share * box.width * torch.sign(torch.nan_to_num(slope)))
            for box, point, slope in zip((start, w), (x, v), slopes, strict=True)
        )
        found = _best(loop, start, w, asked, x, v, found)
        if found is not None and found.proved:
            break
    return found


def _corners(box: Box, generator: torch.Generator) -> Tensor:
    """The centre, random points and random corners, ``(ROLLOUTS, n)``."""
    x = box.sample(ROLLOUTS, generator)
    upper = torch.rand(x.shape, generator=generator) < 0.5
    x[1::2] = torch.where(upper, box.upper, box.lower)[1::2]
    x[0] = box.center
    return x


def _into(box: Box, point: Tensor) -> Tensor:
    return torch.minimum(torch.maximum(point, box.lower), box.upper)


def _margins(one: Asked, states: Tensor) -> Tensor:
    found = one.margins.value.run(states, torch.zeros_like(states)).control
    return one.worst(found.expand(*states.shape[:-1], -1))


def _least(asked: Sequence[Asked], loop: SampledLoop, states: Tensor) -> Tensor:
    """The least margin of each requirement over its times, ``(B, R)``."""
    return torch.stack([_margins(one, states)[:, one.times(loop, STEPS)[0]].amin(1) for one in asked], 1)


@torch.no_grad()
def _best(
    loop: SampledLoop, start: Box, w: Box, asked: Sequence[Asked], x: Tensor, v: Tensor, before: Violation | None
) -> Violation | None:
    """The deepest violation of each requirement is tried; the first that is proved, or the deepest one."""
    least = torch.nan_to_num(_least(asked, loop, simulated(loop, x, v)), nan=torch.inf)
    best = before
    for r in range(len(asked)):
        value, row = least[:, r].min(0)
        if asked[r].formula.holds(value) or (best is not None and float(value) >= -best.depth):
            continue
        one = _replayed(loop, x[row], v[row], asked[r])
        if one.proved:
            return one
        best = one
    return best


def _replayed(loop: SampledLoop, x: Tensor, v: Tensor, one: Asked) -> Violation:
    """The solution from one start under one disturbance, bounded until the requirement is proved broken."""
    states = simulated(loop, x[None], v[None])[0]
    ends, _ = one.times(loop, STEPS)
    margins = torch.where(ends, _margins(one, states), torch.inf)
    broken = ~one.formula.holds(margins)
    worst = int(margins.argmin())
    times = torch.arange(len(states), dtype=torch.float64) * (loop.period / STEPS)
    point = Box(x[None].clone(), x[None].clone())
    upto = min(loop.horizon, -(-worst // STEPS))
    proved, time = False, float(times[int(broken.to(torch.int8).argmax())])
    for division in _REPLAYS if upto else ():
        found = reach_continuously(
            Affine(), loop.part(0, upto), point, Box(v, v), substeps=division.substeps, order=division.order
        )
        broken_at = _surely(one, loop, found, ends, division)
        if broken_at is not None:
            proved, time = True, broken_at
            break
    if not upto:
        _, most = at_boxes(one.margins, point)
        proved = bool(ends[0]) and not bool(one.formula.holds(one.worst(most))[0])
    return Violation(x, v, states, times, one.formula.name, time, -float(margins[worst]), proved)


def _surely(one: Asked, loop: SampledLoop, found: Reach, ends: Tensor, division: Division) -> float | None:
    """The first time, of those asked for, at which all states of an enclosure break the requirement; in seconds."""
    flow, every = found.flow, STEPS // division.substeps
    assert flow is not None
    sides = ((flow.state_lower, found.tube.lower), (flow.state_upper, found.tube.upper))
    boxes = Box(*(torch.cat([side.flatten(1, 2)[0], end[0, -1:]]) for side, end in sides))
    _, most = at_boxes(one.margins, boxes)
    surely = ends[::every][: len(most)] & ~one.formula.holds(one.worst(most))
    return float(surely.to(torch.int8).argmax()) * loop.period / division.substeps if bool(surely.any()) else None
