"""One shape for cells, references and loops that share a batch."""

from __future__ import annotations

import torch

from sagemp_cli.errors import UsageError
from sagemp_cli.reachability.propagator import Loop
from sagemp_cli.sets import Box


@torch.no_grad()
def batched_start(loop: Loop, start: Box, disturbance: Box) -> Box:
    """The start box in the batch shape of the loop's results: what one plain step from its centre gives.

    Args:
        loop: may have a batch of its own, as references have.
        start: ``(..., n)``.
        disturbance: ``(d,)``.

    Raises:
        UsageError: boxes that do not fit the loop.
    """
    n = loop.state_dim
    if start.dim != n:
        raise UsageError(f"the start box has {start.dim} dimensions, the loop's state has {n}")
    if disturbance.lower.dim() != 1:
        raise UsageError(f"the disturbance must be one box (d,), found shape {tuple(disturbance.lower.shape)}")
    shape = loop.step(0, start.center, disturbance.center).shape
    return Box(start.lower.expand(shape), start.upper.expand(shape))
