"""What a certificate keeps of a proof: every relaxation that was used, and which generators were kept.

A checker that is given these, the loop and the sets can redo the proof without trusting how they were chosen: a
bad choice only makes its tube wider, or its check of the recorded radius fail.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.reachability.relaxations.arctangent2 import Turn
from sagemp_cli.reachability.relaxations.band import Band


def recorded_bands(
    name: str, band: Band, turn: Turn | None, ratio: Any = None, given: Sequence[Any] = ()
) -> list[tuple[str, Band]]:
    """What is kept of an operation: its band, and of an angle the direction that its line is across, of a choice the
    ratio that its bounds rest on and which branch was taken, written as one.
    """
    if ratio is not None:
        return [(name, band), ("ratio", Band(ratio, given[0], 0.0 * ratio))]
    if turn is None:
        return [(name, band)]
    return [(name, band), ("direction", Band(turn.cosine, turn.sine, 0.0 * turn.cosine))]


@dataclass(frozen=True)
class Recording:
    """The relaxations of every step, side by side; a loop evaluates the same operations at every step.

    Attributes:
        operations: names in the order of evaluation.
        widths: entries of each operation; together E.
        slope, offset, radius: the bands, ``(*batch, K, E)``; of a product the slope is the power-of-two scale.
        kept: ``(*batch, K, bytes)``, bit j of row k (least significant first) says whether column j of the
            generators was kept at the end of step k; None if nothing was dropped.
    """

    operations: tuple[str, ...]
    widths: tuple[int, ...]
    slope: Tensor
    offset: Tensor
    radius: Tensor
    kept: Tensor | None = None

    @staticmethod
    def of(bands: Sequence[Sequence[tuple[str, Band]]], batch: torch.Size, kept: Sequence[np.ndarray]) -> Recording:
        """From a run's bands and masks of kept generators, ``(columns,)`` or ``(B, columns)``, per step.

        Args:
            bands: in the order of evaluation, ``(B, E)`` each, of the B cells of the batch.
            batch: its shape.
            kept: masks.
        """
        cells, first = math.prod(batch), bands[0]

        def stacked(part: int) -> Tensor:
            rows = [
                np.concatenate([np.zeros((cells, 0)), *(band[part] for _, band in step)], axis=-1) for step in bands
            ]
            return torch.from_numpy(np.stack(rows, axis=1)).reshape(*batch, len(bands), -1)

        return Recording(
            operations=tuple(name for name, _ in first),
            widths=tuple(band.radius.shape[-1] for _, band in first),
            slope=stacked(0),
            offset=stacked(1),
            radius=stacked(2),
            kept=_packed(kept, batch) if len(kept) else None,
        )

    def select(self, index: Tensor) -> Recording:
        """The same for some of the first batch dimension."""
        return self._map(lambda t: t[index])

    @staticmethod
    def join(parts: Sequence[Recording | None]) -> Recording | None:
        """Recordings of the same loop, one after the other; None if one of them is missing or differs in structure."""
        known = [p for p in parts if p is not None]
        if len(known) < len(parts) or len({(p.operations, p.widths, p.kept is None) for p in known}) != 1:
            return None
        size = max(0 if p.kept is None else p.kept.shape[-1] for p in known)  # cells of other chunks keep others
        return Recording(
            known[0].operations,
            known[0].widths,
            *(torch.cat([getattr(p, name) for p in known]) for name in ("slope", "offset", "radius")),
            kept=None
            if known[0].kept is None
            else torch.cat([_padded(p.kept, size) for p in known if p.kept is not None]),
        )

    def _map(self, change) -> Recording:
        kept = None if self.kept is None else change(self.kept)
        return Recording(
            self.operations, self.widths, change(self.slope), change(self.offset), change(self.radius), kept
        )


def _packed(masks: Sequence[np.ndarray], batch: torch.Size) -> Tensor:
    """Masks of several lengths as rows of bits, least significant first, padded with zeros."""
    size = -(-max(m.shape[-1] for m in masks) // 8)
    rows = np.zeros((math.prod(batch), len(masks), 8 * size), dtype=bool)
    for k, mask in enumerate(masks):
        rows[:, k, : mask.shape[-1]] = mask
    return torch.from_numpy(np.packbits(rows, axis=-1, bitorder="little")).reshape(*batch, len(masks), size)


def _padded(rows: Tensor, size: int) -> Tensor:
    """Rows of that length, filled up with zeros."""
    return torch.nn.functional.pad(rows, (0, size - rows.shape[-1]))
