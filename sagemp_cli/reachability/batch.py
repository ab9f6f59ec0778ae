"""One batch shape for a loop with several references and a start box with several cells."""

from __future__ import annotations

import numpy as np
import torch

from sagemp_cli.errors import UsageError
from sagemp_cli.loop.closed_loop import ClosedLoop, FoldedLoop
from sagemp_cli.reachability.program.loops import RecordedLoop
from sagemp_cli.reachability.propagator import Loop
from sagemp_cli.sets import Box


def batched_start(loop: Loop, start: Box, disturbance: Box) -> Box:
    """The start box, broadcast against the batch of the loop's references.

    Args:
        loop: a :class:`~.closed_loop.ClosedLoop`, folded or not, or a recorded loop may have a batch; any other loop
            has none of its own.
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
    own = torch.Size()
    if isinstance(loop, ClosedLoop):
        own = loop.references.shape[:-2]
    elif isinstance(loop, FoldedLoop):
        own = loop.biases.shape[:-2]
    elif isinstance(loop, RecordedLoop):
        own = loop.batch
    shape = (*np.broadcast_shapes(own, start.lower.shape[:-1]), n)
    return Box(start.lower.expand(shape), start.upper.expand(shape))
