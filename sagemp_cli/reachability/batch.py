"""One batch shape for a loop with several references and a start box with several cells."""

from __future__ import annotations

import numpy as np

from sagemp_cli.errors import UsageError
from sagemp_cli.reachability.program.loops import RecordedLoop, recorded
from sagemp_cli.reachability.propagator import Loop
from sagemp_cli.sets import Box


def recorded_and_batched(
    loop: Loop, start: Box, disturbance: Box, *, varying: bool = False
) -> tuple[RecordedLoop, Box]:
    """The loop as programs, and the start box in the batch shape that both have together.

    Args:
        loop: what steps; a recorded one may have a batch.
        start: ``(..., n)``.
        disturbance: ``(d,)``.
        varying: whether the disturbance may be one box for each step and cell instead, ``(K, B, d)``.

    Raises:
        UsageError: boxes that do not fit the loop.
    """
    n = loop.state_dim
    if start.dim != n:
        raise UsageError(f"the start box has {start.dim} dimensions, the loop's state has {n}")
    if disturbance.lower.dim() != 1 and not varying:
        raise UsageError(f"the disturbance must be one box (d,), found shape {tuple(disturbance.lower.shape)}")
    known = recorded(loop, start, disturbance)
    shape = (*np.broadcast_shapes(known.batch, start.lower.shape[:-1]), n)
    return known, Box(start.lower.expand(shape), start.upper.expand(shape))
