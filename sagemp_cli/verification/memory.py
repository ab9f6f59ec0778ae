"""Memory of a verification, estimated before it begins: how many cells at once keep within a budget.

The estimates count the arrays that are alive at the worst moment, with what one step of the loop shows: how many
generators it adds and how many entries its nonlinear operations have. They are compared with measured peaks in the
tests, and are meant to be above them.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from sagemp_cli.errors import ResourceError
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.propagator import Footprint, LoopSize, Propagator
from sagemp_cli.sets import Box
from sagemp_cli.verification.cells import CellProver, Chunk

GIB = 2.0**30
MOST_AT_ONCE = 128
"""Cells in one call at most: more do not make it faster."""

HEAP = 4.5
"""Heap over arrays, as blocks of thousands of sizes leave gaps: 1 to 4.3 was measured, the most with 12 states."""


@torch.no_grad()
def footprint(prover: CellProver, reference: Tensor) -> Footprint:
    """What one cell of a reference ``(K+1, n)`` takes.

    The propagator says it of a loop of some size (:meth:`~sagemp_cli.reachability.propagator.Propagator.footprint`),
    its working memory in arrays, which :data:`HEAP` makes memory; the size is that of the first step.
    """
    propagator, problem = prover.propagator, prover.problem
    steps, n, d = len(reference) - 1, problem.dynamics.state_dim, problem.disturbance.dim
    middle = problem.start.center.reshape(-1, n)[:1]
    first = Chunk(0, torch.zeros(1, dtype=torch.int64), reference[None, :2], Box(middle, middle))
    found = prover.prove(first)
    if found.recording is None:
        found = dataclasses.replace(prover, propagator=Affine()).prove(first)
    assert found.recording is not None
    controls = found.control_lower.shape[-1]
    size = LoopSize.of(found.recording, steps, n, d, controls)
    arrays = propagator.footprint(size)
    return Footprint(None if arrays.working is None else HEAP * arrays.working, arrays.kept)


def cells_within(memory: float, cells: int, found: Footprint, propagator: Propagator) -> int:
    """Cells to propagate at once so that the working memory and the results of all keep within ``memory`` GiB.

    Args:
        memory: GiB, of this process for all results and of each process that propagates for its chunk.
        cells: at most, altogether.
        found: of one cell.
        propagator: for the message.

    Raises:
        ResourceError: the results and one cell at a time need more.
    """
    results = 2 * cells * found.kept  # joined from chunks, which are there as well
    working = found.working or 0.0
    if results + working > memory * GIB:
        raise ResourceError(
            f"proof.memory is {memory:g} GiB, but the tubes and relaxations of up to {cells} cells need "
            f"{results / GIB:.2g} GiB, and '{propagator.name}' {working / GIB:.2g} GiB for one cell at a time; "
            f"raise proof.memory, or verify fewer references or cells"
        )
    if not working:
        return MOST_AT_ONCE
    return int(min(MOST_AT_ONCE, (memory * GIB - results) // working))
