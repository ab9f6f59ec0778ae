"""The certified reference closest to what the planner proposes (equation 10 of the paper)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sagemp_cli.errors import UsageError

TREE_FROM = 1000
"""Library size from which a k-d tree is built; below, comparing with every entry is faster."""


def closest_reference(
    sampled: NDArray[np.float64],
    library: NDArray[np.float64],
    *,
    eligible: NDArray[np.bool_] | None = None,
    tree_from: int = TREE_FROM,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Indices ``i*`` and errors ``E_tau = min_i sum_{k=1..K} |tau_k^i - tau_k^samp|^2``, both ``(Q,)``.

    As in the paper the sum starts at k = 1 and is over all states, in their units. Of equally close entries the
    first is taken.

    Args:
        sampled: proposals ``(Q, K+1, n)``.
        library: certified references ``(C, K+1, n)``.
        eligible: which entries each proposal may choose, ``(Q, C)``; all if None.
        tree_from: library size from which a k-d tree replaces the comparison with every entry.

    Raises:
        UsageError: the library is empty, shapes differ, or a proposal has no eligible entry.
    """
    if len(library) == 0:
        raise UsageError("the library holds no certified reference")
    if sampled.shape[1:] != library.shape[1:]:
        raise UsageError(f"proposals of shape {sampled.shape[1:]} do not fit a library of shape {library.shape[1:]}")
    if eligible is not None and not eligible.any(-1).all():
        query = int(np.flatnonzero(~eligible.any(-1))[0])
        raise UsageError(f"proposal {query} has no eligible reference in the library")
    points = library[:, 1:].reshape(len(library), -1)
    queries = sampled[:, 1:].reshape(len(sampled), -1)
    if len(library) >= tree_from and (eligible is None or eligible.all()):
        from scipy.spatial import KDTree

        _, index = KDTree(points).query(queries)
        index = np.asarray(index, dtype=np.int64)
    else:
        index = np.empty(len(queries), dtype=np.int64)
        for q, query in enumerate(queries):  # one at a time: the differences of all pairs would not fit in memory
            errors = np.square(points - query).sum(-1)
            index[q] = np.argmin(errors if eligible is None else np.where(eligible[q], errors, np.inf))
    return index, np.square(points[index] - queries).sum(-1)
