"""The reach set from inside: the widest rollouts that gradient ascent finds, and attacks on a tube.

Random sampling says little about a tube, since disturbances average out; the ascent is what widths are compared with.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.errors import UsageError
from sagemp_cli.reachability.propagator import Loop
from sagemp_cli.sets import Box, Tube
from sagemp_cli.verification.attack.ascent import Rollouts, ascend, first_units, place, simulate

SIMULATION_MARGIN = 1e-12
"""Relative margin granted to a plain float64 simulation, which itself rounds: ``1e-12 max(1, |x|)`` per coordinate."""


@dataclass(frozen=True)
class InnerEstimate:
    """Boxes that touch states which rollouts do reach: no tube can be smaller.

    Attributes:
        lower: least value reached per step and coordinate, ``(K+1, n)``.
        upper: largest value reached, ``(K+1, n)``.
    """

    lower: Tensor
    upper: Tensor

    @property
    def width(self) -> Tensor:
        """``upper - lower``, ``(K+1, n)``."""
        return self.upper - self.lower

    def ratio(self, tube: Tube) -> Tensor:
        """The tube's width over this width, ``(K+1, n)``; NaN where nothing varies here."""
        return torch.where(self.width > 0, tube.width / self.width, torch.nan)


@dataclass(frozen=True)
class Attack:
    """What :func:`attack_tube` found.

    Attributes:
        rollouts: how many rollouts were compared with the tube.
        outside: rollouts outside by any amount, no tolerance at all.
        escapes: rollouts outside by more than :data:`SIMULATION_MARGIN`; of a sound tube there are none.
        excess: largest signed distance out of the tube over all steps and coordinates; negative is inside.
        step: where that was.
        coordinate: where that was.
    """

    rollouts: int
    outside: int
    escapes: int
    excess: float
    step: int
    coordinate: int


def _widest(
    loop: Loop,
    start: Box,
    disturbance: Box,
    targets: Tensor,
    rates: Sequence[float],
    generator: torch.Generator,
    restarts: int = 1,
) -> Iterator[Rollouts]:
    """Rollouts ``(targets, restarts)`` pushed to targets ``(targets, 3)``: step, coordinate, sign."""
    step, coordinate, sign = targets.unbind(-1)
    rows = torch.arange(len(targets))

    def score(states: Tensor) -> Tensor:
        return sign[:, None] * states[rows, :, step, coordinate]

    x, w = first_units((len(targets), restarts), loop.horizon, start, disturbance, generator)
    yield from ascend(loop, start, disturbance, score=score, start_unit=x, disturbance_unit=w, rates=rates)


def inner_estimate(
    loop: Loop,
    start: Box,
    disturbance: Box,
    *,
    generator: torch.Generator,
    steps: Sequence[int] | None = None,
    restarts: int = 2,
    rates: tuple[float, ...] = (2.0, 2.0, 1.0, 0.5),
    chunk: int = 1024,
) -> InnerEstimate:
    """The widest rollouts of one loop, searched for each step, coordinate and sign by gradient ascent.

    Every rollout of every ascent counts at every step, so steps that were not asked for get a (smaller) estimate
    too. Exact on affine loops.

    Args:
        loop: one reference.
        start: ``(n,)``.
        disturbance: ``(d,)``.
        generator: draws the restarts after the first, which begins in the middle.
        steps: the steps searched for; all by default.
        restarts: ascents for each step, coordinate and sign.
        rates: see :func:`~sagemp_cli.verification.attack.ascent.ascend`.
        chunk: rollouts held at once; memory grows with it.
    """
    wanted = range(1, loop.horizon + 1) if steps is None else steps
    if not wanted or not all(0 <= k <= loop.horizon for k in wanted):
        raise UsageError(f"inner estimate: steps must lie in 0..{loop.horizon}, found {list(wanted)}")
    targets = torch.cartesian_prod(
        torch.tensor(list(wanted)), torch.arange(loop.state_dim), torch.tensor([-1, 1])
    ).reshape(-1, 3)
    lower = torch.full((loop.horizon + 1, loop.state_dim), torch.inf, dtype=torch.float64)
    upper = -lower
    for part in targets.split(max(1, chunk // restarts)):
        for trial in _widest(loop, start, disturbance, part, rates, generator, restarts):
            states = trial.states.flatten(0, -3)
            # A rollout that overflew is no witness of anything finite.
            states = states[torch.isfinite(states).flatten(-2).all(-1)]
            if len(states):
                lower = torch.minimum(lower, states.amin(0))
                upper = torch.maximum(upper, states.amax(0))
    # Every corner of the start box is a start.
    lower[0], upper[0] = start.lower, start.upper
    return InnerEstimate(lower, upper)


def _families(
    loop: Loop, start: Box, disturbance: Box, count: int, chunk: int, generator: torch.Generator
) -> Iterator[Tensor]:
    """States ``(rollouts, K+1, n)`` of ``count`` rollouts in all, in turn from each family of attacks."""
    n, d, horizon = loop.state_dim, disturbance.dim, loop.horizon
    rates = (2.0, 1.0, 0.5)

    def uniform(*shape: int) -> Tensor:
        return 2 * torch.rand(*shape, dtype=torch.float64, generator=generator) - 1

    family, done = 0, 0
    while done < count:
        size = min(chunk, count - done)
        if family == 4 and size > len(rates):
            # Each ascent gives len(rates) + 1 rollouts: a random step, coordinate and sign.
            rows = max(1, size // (len(rates) + 1))
            targets = torch.stack(
                [torch.randint(high, (rows,), generator=generator) for high in (horizon, n, 2)], dim=-1
            )
            targets = torch.stack([targets[:, 0] + 1, targets[:, 1], 2 * targets[:, 2] - 1], dim=-1)
            for trial in _widest(loop, start, disturbance, targets, rates, generator):
                yield trial.states[:, 0]
            done += rows * (len(rates) + 1)
        else:
            x, w = uniform(size, n), uniform(size, horizon, d)
            if family in (1, 2):
                w = torch.sign(w)
            if family in (2, 3, 4):
                x = torch.sign(x)
            if family in (3, 4):
                w = torch.sign(w[:, :1]).expand(-1, horizon, -1)
            with torch.no_grad():
                yield simulate(loop, place(start, x), place(disturbance, w))
            done += size
        family = (family + 1) % 5


def attack_tube(
    loop: Loop,
    start: Box,
    disturbance: Box,
    tube: Tube,
    *,
    count: int,
    generator: torch.Generator,
    chunk: int = 2048,
) -> Attack:
    """Compares ``count`` rollouts of one loop with its tube ``(K+1, n)``.

    Five families take turns, a chunk each: uniform; uniform starts under random bang-bang disturbances; corners under
    bang-bang; corners under one vertex held; gradient ascent on a random step, coordinate and sign. The chunk shrinks
    so that a small ``count`` still has all of them.

    Args:
        loop: one reference.
        start: ``(n,)``.
        disturbance: ``(d,)``.
        tube: one tube; for cells, the hull of theirs.
        count: rollouts.
        generator: draws them.
        chunk: rollouts held at once.
    """
    if count < 1:
        raise UsageError(f"attack: count must be a positive integer, found {count}")
    if tube.lower.shape != (loop.horizon + 1, loop.state_dim):
        raise UsageError(
            f"attack: tube must have shape ({loop.horizon + 1}, {loop.state_dim}), found {tuple(tube.lower.shape)}"
        )
    outside = escapes = rollouts = 0
    worst, step, coordinate = -torch.inf, 0, 0
    for states in _families(loop, start, disturbance, count, min(chunk, -(-count // 5)), generator):
        excess = torch.maximum(states - tube.upper, tube.lower - states)
        # NaN: a state that overflew; only a bound that is infinite too contains it.
        unbounded = torch.isinf(tube.lower) & torch.isinf(tube.upper)
        excess = torch.where(unbounded, -torch.inf, torch.nan_to_num(excess, nan=torch.inf))
        outside += int((excess > 0).flatten(1).any(1).sum())
        granted = SIMULATION_MARGIN * states.abs().nan_to_num(nan=0.0).clamp(min=1.0)
        escapes += int((excess > granted).flatten(1).any(1).sum())
        rollouts += len(states)
        value, where = excess.flatten().max(0)
        if float(value) > worst:
            worst = float(value)
            step, coordinate = divmod(int(where) % tube.lower.numel(), loop.state_dim)
    return Attack(rollouts, outside, escapes, worst, step, coordinate)
