"""Disturbance sequences to execute under: drawn at random, or chosen to do harm."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from sagemp_cli.sets import Box


class Loop(Protocol):
    """Anything that turns starts and disturbances into rollouts: a closed loop, or controls that are played back."""

    @property
    def horizon(self) -> int:
        """Number of steps K."""
        ...

    @property
    def state_dim(self) -> int:
        """Number of states n."""
        ...

    def rollout(self, x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
        """States ``(..., K+1, n)`` and controls ``(..., K, m)`` from starts ``(..., n)`` and ``w (..., K, d)``."""
        ...


def random_disturbances(disturbance: Box, count: int, *, horizon: int, generator: torch.Generator) -> Tensor:
    """Sequences ``(count, K, d)``, each entry uniform in W and independent of the others."""
    return disturbance.sample(count * horizon, generator).unflatten(0, (count, horizon))


def worst_case_disturbances(
    loop: Loop,
    starts: Tensor,
    *,
    disturbance: Box,
    generator: torch.Generator,
    rounds: int = 2,
) -> Tensor:
    """Sequences ``(B, K, d)`` at the corners of W that push each rollout as far as they can, to first order.

    Every rollout gets a state, a sign and a step at random; its disturbances are the corner of W in the direction of
    the gradient of that state at that step, recomputed ``rounds`` times. For a linear loop this is the exact worst
    case of that state; here it is a strong heuristic, no bound.

    Args:
        loop: with references (or controls) that broadcast against the starts.
        starts: ``(B, n)``.
        disturbance: W.
        generator: chooses what to push.
        rounds: gradient evaluations; each is a rollout and its back-propagation.
    """
    count, n, horizon = len(starts), loop.state_dim, loop.horizon
    state = torch.randint(n, (count,), generator=generator)
    step = 1 + torch.randint(horizon, (count,), generator=generator)
    sign = 1.0 - 2.0 * torch.randint(2, (count,), generator=generator).double()
    w = disturbance.center.expand(count, horizon, disturbance.dim).clone()
    for _ in range(rounds):
        w.requires_grad_(True)
        states, _ = loop.rollout(starts, w)
        pushed = (sign * states[torch.arange(count), step, state]).sum()
        (slope,) = torch.autograd.grad(pushed, w)
        # Where the gradient vanishes (steps after the chosen one) either corner will do.
        w = torch.where(slope >= 0, disturbance.upper, disturbance.lower)
    return w.detach()
