"""Memory of a verification, estimated before it begins: how many cells at once keep within a budget.

The estimates count the arrays that are alive at the worst moment, with what one step of the loop shows: how many
generators it adds and how many entries its nonlinear operations have. They are compared with measured peaks in the
tests, and are meant to be above them.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.errors import ResourceError
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.propagator import Propagator
from sagemp_cli.sets import Box
from sagemp_cli.verification.cells import CellProver, Chunk

GIB = 2.0**30
MOST_AT_ONCE = 128
"""Cells in one call at most: more do not make it faster."""

HEAP = 4.5
"""Heap over arrays, as blocks of thousands of sizes leave gaps: 1 to 4.3 was measured, the most with 12 states."""

_NUMBER = 8  # bytes of a float64


@dataclass(frozen=True)
class Footprint:
    """Bytes of one cell.

    Attributes:
        working: while it is propagated, given up afterwards; None if nothing is known of the propagator.
        kept: of its tube and recorded relaxations.
    """

    working: float | None
    kept: float


@torch.no_grad()
def footprint(prover: CellProver, reference: Tensor) -> Footprint:
    """What one cell of a reference ``(K+1, n)`` takes.

    With n states, d disturbances, M generators at the last step, E entries of nonlinear operations a step (H of the
    widest one) and v = n + d + E variables a step, in numbers of 8 bytes:

    - kept, with m columns of bounds beside the states: ``2 (K+1) n + 2 K m + 3 K E`` and a bit per generator and step,
      as many as if none were negligible;
    - working, times :data:`HEAP`, of ``affine``: ``M (6 n + 3 H) + 12 v^2 + 2 kept``;
    - of ``crown`` and ``best``: as ``affine``, ``K (3 v^2 + 2 v n)`` for the steps and ``6 rows v`` for the sweep;
    - of ``interval``: ``40 v + 2 kept``.
    """
    propagator, problem = prover.propagator, prover.problem
    steps, n, d = len(reference) - 1, problem.dynamics.state_dim, problem.disturbance.dim
    shown = prover if hasattr(propagator, "prove") else dataclasses.replace(prover, propagator=Affine())
    middle = problem.start.center.reshape(-1, n)[:1]
    first = Chunk(0, torch.zeros(1, dtype=torch.int64), reference[None, :2], Box(middle, middle))
    found = shown.prove(first)
    assert found.recording is not None
    entries, widest = found.recording.slope.shape[-1], max(found.recording.widths, default=1)
    m = found.control_lower.shape[-1]
    symbols = getattr(propagator, "symbols", None)
    v = n + d + entries
    generators = n + steps * v  # each step adds its disturbances, its relaxations and a column of rounding per state
    generators = generators if symbols is None else min(generators, max(symbols, n + 1) + v)
    kept = 2 * (steps + 1) * n + 2 * steps * m + 3 * steps * entries
    kept += steps * generators / 64
    working = {
        "affine": generators * (6 * n + 3 * widest) + 12 * v**2 + 2 * kept,
        "interval": 40 * v + 2 * kept,
    }
    rows = getattr(propagator, "rows", 0)
    working["crown"] = working["best"] = (
        working["affine"] + steps * (3 * v**2 + 2 * v * n) + 6 * min(rows, 2 * steps * n) * v
    )
    needed = working.get(propagator.name)
    return Footprint(None if needed is None else HEAP * _NUMBER * needed, _NUMBER * kept)


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
