"""Do cells cover a box? Decided exactly, for any boxes: float64 numbers are compared, never computed with."""

from __future__ import annotations

import numpy as np

_MOST_PIECES = 200_000


def covered(lower: np.ndarray, upper: np.ndarray, cells_lower: np.ndarray, cells_upper: np.ndarray) -> bool:
    """Whether every point of ``[lower, upper]`` (n numbers each) lies in one of the closed cells ``(C, n)``.

    A piece of the box is done if one cell contains it, else it is cut at a face of a cell that runs through it.
    True is a proof; False also if the pieces become too many.
    """
    todo, pieces = [(lower, upper, np.arange(len(cells_lower)))], 0
    while todo:
        low, high, some = todo.pop()
        # Cells that share no interior point with the piece (in its dimensions of positive width) cannot help.
        a, b = cells_lower[some], cells_upper[some]
        meets = np.where(low < high, (a < high) & (b > low), (a <= low) & (high <= b)).all(axis=1)
        some, a, b = some[meets], a[meets], b[meets]
        if ((a <= low) & (high <= b)).all(axis=1).any():
            continue
        pieces += 1
        if len(some) == 0 or pieces > _MOST_PIECES:
            return False
        inner = [np.unique(np.r_[f[(f > lo) & (f < hi)]]) for f, lo, hi in zip(np.r_[a, b].T, low, high, strict=True)]
        dimension = int(np.argmax([len(faces) for faces in inner]))
        faces = inner[dimension]
        cut = faces[len(faces) // 2]  # there is one: a cell that meets the piece and has no face inside contains it
        left, right = high.copy(), low.copy()
        left[dimension] = right[dimension] = cut
        todo += [(low, left, some), (right, high, some)]
    return True
