"""How much of a tube's width is there because a limit on the number of generators had some of them boxed.

The box around a generator is one generator along each axis. All but the one along the axis where it is longest are
*excess*: the set did not need them (a generator along an axis loses nothing). The loop takes a box along as it does all
generators, so what share of the width is excess can be followed from step to step. To first order the tube would
without boxing be as wide as what is left.
"""

from __future__ import annotations

from typing import Any

import numpy as np

SHARE = 0.5
"""Share of the width from which on it is said."""


CELLS = 16
"""Cells of a batch that are followed at most, evenly spread: all would take a sixth of a propagation, for a note."""


class Boxed:
    """Follows the excess of boxes.

    Args:
        symbols: the limit.

    Attributes:
        share: of the width, largest so far over the cells followed, states and steps.
    """

    def __init__(self, symbols: int | None) -> None:
        self.symbols, self.share = symbols, 0.0
        self._excess = np.zeros((1, 0))  # which part of each generator is, (B, M) or (1, M)

    def follow(self, generators: Any, kept: Any) -> None:
        """A step.

        Args:
            generators: after it, none dropped yet, ``(*batch, n, M)``.
            kept: mask of those that are kept, ``(M,)`` or ``(*batch, M)``, as many of each cell; None: all. The others
                become n generators of a box, which come last.
        """
        if self.symbols is None:
            return
        n, count = generators.shape[-2:]
        all_cells = np.asarray(generators).reshape(-1, n, count)
        every = -(-len(all_cells) // CELLS)
        size = np.abs(all_cells[::every])
        cells = len(size)
        excess = np.zeros((cells, count))  # what the step added has none
        excess[:, : self._excess.shape[-1]] = self._excess
        boxed = np.zeros((cells, count), dtype=bool)
        if kept is not None:
            masks = np.asarray(kept).reshape(-1, count)
            boxed |= ~(masks[::every] if len(masks) == len(all_cells) else masks)
        parts = (size @ np.where(boxed, 0.0, excess)[..., None])[..., 0]
        self._excess = excess
        if boxed.any():
            which = np.nonzero(boxed)[1].reshape(cells, -1)
            box = np.take_along_axis(size, which[:, None], axis=-1)
            longest = box == box.max(axis=-2, keepdims=True)
            own = np.where(longest, box * np.take_along_axis(excess, which, axis=-1)[:, None], box).sum(-1)
            parts = parts + own
            along = own / np.maximum(box.sum(-1), 1e-300)
            self._excess = np.concatenate([excess[~boxed].reshape(cells, -1), along], axis=-1)
        share = parts / np.maximum(size.sum(-1), 1e-300)
        self.share = max(self.share, float(np.max(share, where=np.isfinite(share), initial=0.0)))

    def notes(self) -> tuple[str, ...]:
        """One line if it is more than :data:`SHARE`."""
        if self.share <= SHARE:
            return ()
        times = 1.0 / max(1.0 - self.share, 1e-12)
        share = f"{100 * self.share:.3g} % of the tube's width"
        return (
            f"symbols={self.symbols}: up to {share} are there because generators were boxed; "
            f"with more symbols it may be up to {times:.2g} times narrower",
        )
