"""Searches for a solution of an ODE that breaks a requirement; one that is found is proved by the engine itself.

The search is in float64: rollouts by the classical Runge-Kutta method, from corners and random starts under signals
that are held, switched at random or switched in turn, at up to :data:`PIECES` times the sample rate; then by gradient
ascent: starts move against the slope of the margin, and every piece of a signal takes the side of W that its slope
points to (bang-bang). What it finds is bounded from its start alone, under its signal: where all states that the
enclosure holds break the requirement, so does the solution.
"""

from __future__ import annotations

import math
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

PIECES = 8
"""Of a period, on which a disturbance is constant, where there is one; each is one Runge-Kutta step."""
STEPS = 4
"""Runge-Kutta steps in a period where there is none."""

ROLLOUTS = 64
"""Of each search."""

_REPLAYS = (Division(1, 2), Division(2, 3), Division(4, 3), Division(16, 3))
"""How a solution is enclosed, until that proves it a violation; by as many parts as its signal has, at least."""

_RATES = (0.5, 0.5, 0.25, 0.25, 0.1, 0.1)
"""Shares of the box of starts that an ascent goes in one step."""


@dataclass(frozen=True)
class Found:
    """What a search found.

    Attributes:
        violation: proved if any that was tried could be; None if float64 shows none, which proves nothing.
        rollouts: so many were simulated.
    """

    violation: Violation | None
    rollouts: int


@dataclass(frozen=True)
class Violation:
    """A solution that breaks a requirement.

    Attributes:
        start: ``(n,)``.
        signal: w on each of equally many pieces of every period, ``(K P, n)``.
        states: at the ends of all pieces, in float64, ``(K P + 1, n)``.
        times: of them, in seconds.
        requirement: its name.
        step, fraction: when the enclosure proves it broken first, in float64 where none does: the period, and the part
            of it that is over, below 1.
        time: the same in seconds.
        depth: how far the margin is below 0 then, in float64.
        proved: whether an enclosure of the solution proves it.
    """

    start: Tensor
    signal: Tensor
    states: Tensor
    times: Tensor
    requirement: str
    step: int
    fraction: float
    time: float
    depth: float
    proved: bool


def pieces_of(w: Box) -> int:
    """Pieces of a period on which a search holds its disturbance."""
    return STEPS if bool((w.lower == w.upper).all()) else PIECES


def simulated(loop: SampledLoop, x: Tensor, signal: Tensor) -> Tensor:
    """States at the ends of all pieces, ``(..., K P + 1, n)``, from starts ``(..., n)`` under signals ``(..., K P, n)``
    that are constant on each of P pieces of a period."""
    pieces = signal.shape[-2] // loop.horizon
    h, states = loop.period / pieces, [x]
    nothing = torch.zeros_like(x)
    for k in range(loop.horizon):
        u = loop.control.run(x, nothing, loop.numbers[k] if loop.numbers.shape[-1] else None).control
        for piece in range(pieces):
            w = signal[..., k * pieces + piece, :]

            def rate(y: Tensor, u: Tensor = u, w: Tensor = w) -> Tensor:
                return loop.rate.run(y, nothing, u).next + w

            a = rate(x)
            b = rate(x + h / 2 * a)
            c = rate(x + h / 2 * b)
            d = rate(x + h * c)
            x = x + h / 6 * (a + 2 * b + 2 * c + d)
            states.append(x)
    return torch.stack(states, -2)


def search(
    loop: SampledLoop, start: Box, w: Box, asked: Sequence[Asked], *, generator: torch.Generator, ascents: bool
) -> Found:
    """Solutions that break what is asked, looked for from random starts, and by ascents if that is wanted."""
    if not asked:
        return Found(None, 0)
    pieces = pieces_of(w)
    x, v = _starts(start, generator), _signals(w, loop.horizon * pieces, generator)
    found, tried = _best(loop, asked, x, v, None), ROLLOUTS
    if not ascents or (found is not None and found.proved):
        return Found(found, tried)
    target = torch.arange(len(x)) % len(asked)
    for share in _RATES:
        x, v = x.detach().requires_grad_(True), v.detach().requires_grad_(True)
        with torch.enable_grad():
            least = _least(asked, loop, simulated(loop, x, v), pieces)
            score = least.gather(1, target[:, None])[:, 0]
            score = score[torch.isfinite(score)].sum()
            if not score.requires_grad:
                break
            slopes = [torch.nan_to_num(slope) for slope in torch.autograd.grad(score, [x, v])]
        x = _into(start, x.detach() - share * start.width * torch.sign(slopes[0]))
        v = torch.where(slopes[1] > 0, w.lower, torch.where(slopes[1] < 0, w.upper, v.detach()))
        found, tried = _best(loop, asked, x, v, found), tried + ROLLOUTS
        if found is not None and found.proved:
            break
    return Found(found, tried)


def _starts(box: Box, generator: torch.Generator) -> Tensor:
    """The centre, random points and random corners, ``(ROLLOUTS, n)``."""
    x = box.sample(ROLLOUTS, generator)
    upper = torch.rand(x.shape, generator=generator) < 0.5
    x[1::2] = torch.where(upper, box.upper, box.lower)[1::2]
    x[0] = box.center
    return x


def _signals(w: Box, count: int, generator: torch.Generator) -> Tensor:
    """Signals of so many pieces, ``(ROLLOUTS, count, n)``: the centre, then corners in fours: held, switched at random
    after one piece and after more, and switched in turn."""
    if bool((w.lower == w.upper).all()):
        return w.lower.expand(ROLLOUTS, count, w.dim)
    lengths = 1 + math.ceil(math.log2(count))
    found = [w.center.expand(count, w.dim)]
    for r in range(1, ROLLOUTS):
        kind, every = r % 4, 1 if r % 4 == 1 else 2 ** (r // 4 % lengths)
        upper = torch.rand(count, w.dim, generator=generator) < 0.5
        if kind == 0:
            upper = upper[:1].expand(count, -1)
        elif kind == 3:
            upper = upper[:1] ^ (torch.arange(count) // every % 2 == 1)[:, None]
        else:
            upper = upper.repeat_interleave(every, 0)[:count]
        found.append(torch.where(upper, w.upper, w.lower))
    return torch.stack(found)


def _into(box: Box, point: Tensor) -> Tensor:
    return torch.minimum(torch.maximum(point, box.lower), box.upper)


def _margins(one: Asked, states: Tensor) -> Tensor:
    found = one.margins.value.run(states, torch.zeros_like(states)).control
    return one.worst(found.expand(*states.shape[:-1], -1))


def _least(asked: Sequence[Asked], loop: SampledLoop, states: Tensor, pieces: int) -> Tensor:
    """The least margin of each requirement over its times, ``(B, R)``."""
    return torch.stack([_margins(one, states)[:, one.times(loop, pieces)[0]].amin(1) for one in asked], 1)


@torch.no_grad()
def _best(
    loop: SampledLoop, asked: Sequence[Asked], x: Tensor, v: Tensor, before: Violation | None
) -> Violation | None:  # fmt: skip
    """The deepest violation of each requirement is tried; the first that is proved, or the deepest one."""
    pieces = v.shape[1] // loop.horizon
    least = torch.nan_to_num(_least(asked, loop, simulated(loop, x, v), pieces), nan=torch.inf)
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
    """The solution from one start under one signal, bounded until the requirement is proved broken."""
    states, pieces = simulated(loop, x[None], v[None])[0], len(v) // loop.horizon
    ends, _ = one.times(loop, pieces)
    margins = torch.where(ends, _margins(one, states), torch.inf)
    broken = ~one.formula.holds(margins)
    worst = int(margins.argmin())
    place = int(broken.to(torch.int8).argmax()) / pieces
    point = Box(x[None].clone(), x[None].clone())
    upto, proved = min(loop.horizon, -(-worst // pieces)), False
    signal = v.unflatten(0, (loop.horizon, pieces))[:upto]
    if upto and bool((signal == signal[:, :1]).all()):
        signal = signal[:, :1]
    for division in _REPLAYS if upto else ():
        parts = max(division.substeps, signal.shape[1])
        each = signal.repeat_interleave(parts // signal.shape[1], 1)
        found = reach_continuously(
            Affine(), loop.beginning(upto), point, Box(each, each), substeps=parts, order=division.order
        )
        broken_at = _surely(one, loop, found)
        if broken_at is not None:
            proved, place = True, broken_at
            break
    if not upto:
        proved = bool(ends[0]) and bool(_all_break(one, point)[0])
    times = torch.arange(len(states), dtype=torch.float64) * (loop.period / pieces)
    step = int(place)
    return Violation(
        x, v, states, times, one.formula.name, step, place - step, place * loop.period, -float(margins[worst]), proved
    )


def _surely(one: Asked, loop: SampledLoop, found: Reach) -> float | None:
    """The first end of a part, of those asked for, at which all states of an enclosure break the requirement; in
    periods."""
    flow = found.flow
    assert flow is not None
    sides = ((flow.state_lower, found.tube.lower, -math.inf), (flow.state_upper, found.tube.upper, math.inf))
    ends_of = (torch.cat([side.flatten(1, 2)[0], end[0, -1:]]).nan_to_num(nan, math.inf, -math.inf)
               for side, end, nan in sides)  # fmt: skip
    boxes = Box(*ends_of)
    parts = flow.division.substeps
    ends, _ = one.times(loop, parts)
    surely = _all_break(one, boxes)
    surely &= ends[: len(surely)]
    return float(surely.to(torch.int8).argmax()) / parts if bool(surely.any()) else None


def _all_break(one: Asked, boxes: Box) -> Tensor:
    """Whether all states of boxes ``(B, n)`` break a requirement; of what is no number nothing is known."""
    _, most = at_boxes(one.margins, boxes)
    known = torch.isfinite(boxes.lower).all(-1) & torch.isfinite(boxes.upper).all(-1)
    worst = one.worst(torch.nan_to_num(most, nan=torch.inf))
    return known & ~one.formula.holds(worst)
