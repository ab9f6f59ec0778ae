"""Gradient ascent on starts and disturbances: the search behind the falsifier, the inner estimate and the attacks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.reachability.propagator import Loop
from sagemp_cli.sets import Box


@dataclass(frozen=True)
class Rollouts:
    """Simulated rollouts and what they came from (plain float64).

    Attributes:
        start: ``(..., n)``.
        disturbances: ``(..., K, d)``.
        states: ``(..., K+1, n)``; row 0 is the start.
    """

    start: Tensor
    disturbances: Tensor
    states: Tensor


def simulate(loop: Loop, start: Tensor, disturbances: Tensor) -> Tensor:
    """States ``(..., K+1, n)`` from starts ``(..., n)`` under disturbances ``(..., K, d)``."""
    if isinstance(loop, ClosedLoop):  # of which a step may depend on the one before
        return loop.rollout(start, disturbances)[0]
    states = [start]
    for k in range(loop.horizon):
        states.append(loop.step(k, states[-1], disturbances[..., k, :]))
    return torch.stack(states, dim=-2)


def place(box: Box, unit: Tensor) -> Tensor:
    """The points of a box at unit coordinates in ``[-1, 1]``; -1 and 1 are exactly its faces."""
    points = box.center + unit * 0.5 * box.width
    points = torch.where(unit <= -1, box.lower, torch.where(unit >= 1, box.upper, points))
    return torch.minimum(torch.maximum(points, box.lower), box.upper)


def ascend(
    loop: Loop,
    start: Box,
    disturbance: Box,
    *,
    score: Callable[[Tensor], Tensor],
    start_unit: Tensor,
    disturbance_unit: Tensor,
    rates: Sequence[float],
) -> Iterator[Rollouts]:
    """Yields one batch of rollouts per iteration, moving each along the sign of its score's gradient.

    The step is taken in unit coordinates and projected, so a rate of 2 jumps to the vertex that is best for the
    linearised loop (exact in one step where the loop is affine) and smaller rates refine. ``len(rates) + 1`` batches
    come; nothing says that the last is the best one.

    Args:
        loop: what steps.
        start: ``(n,)``, or anything that broadcasts against ``start_unit``.
        disturbance: ``(d,)``.
        score: states ``(..., K+1, n)`` to one number per rollout ``(...)``.
        start_unit: first starts ``(..., n)`` in ``[-1, 1]``.
        disturbance_unit: first disturbances ``(..., K, d)`` in ``[-1, 1]``.
        rates: step of each iteration, in units of half a box.
    """
    a, b = start_unit, disturbance_unit
    for rate in rates:
        x, w = place(start, a).requires_grad_(), place(disturbance, b).requires_grad_()
        states = simulate(loop, x, w)
        gradients = torch.autograd.grad(score(states).sum(), (x, w), allow_unused=True, materialize_grads=True)
        yield Rollouts(x.detach(), w.detach(), states.detach())
        # The sign of NaN (a rollout that overflew) is NaN: such a rollout stays where it is.
        a, b = (
            (unit + rate * torch.nan_to_num(torch.sign(g))).clamp(-1, 1)
            for unit, g in zip((a, b), gradients, strict=True)
        )
    x, w = place(start, a), place(disturbance, b)
    with torch.no_grad():
        states = simulate(loop, x, w)
    yield Rollouts(x, w, states)


def first_units(
    rollouts: tuple[int, ...], horizon: int, start: Box, disturbance: Box, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Where searches begin: the middle first, then uniform points, then corners and bang-bang, in turn.

    Returns:
        Unit coordinates of starts ``(*rollouts, n)`` and of disturbances ``(*rollouts, K, d)``.
    """
    uniform = [
        2 * torch.rand(*rollouts, *shape, dtype=torch.float64, generator=generator) - 1
        for shape in ((start.dim,), (horizon, disturbance.dim))
    ]
    kind = torch.arange(rollouts[-1]) % 2
    x = torch.where(kind[:, None] == 0, torch.sign(uniform[0]), uniform[0])
    w = torch.where(kind[:, None, None] == 0, torch.sign(uniform[1]), uniform[1])
    x[..., 0, :], w[..., 0, :, :] = 0.0, 0.0
    return x, w
