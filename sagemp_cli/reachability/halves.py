"""What halving a start box would do to its tube, foreseen from one propagation of it. A guide: it proves nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.sets import Tube


@dataclass(frozen=True)
class Halves:
    """Of each cell, for every state whose interval of starts may be halved.

    Attributes:
        shift: how far the tube of the upper half moves, that of the lower one the other way, ``(C, n, K+1, n)``.
        narrowing: how much nearer to each other its bounds come, on either side, ``(C, n, K+1, n)``.
    """

    shift: Tensor
    narrowing: Tensor

    def tubes(self, tube: Tube, dimension: int) -> Tube:
        """Of both halves in one state, the lower one first, ``(C, 2, K+1, n)``, from the cells' own ``(C, K+1, n)``."""
        shift = torch.stack([-self.shift[:, dimension], self.shift[:, dimension]], 1)
        narrowing = self.narrowing[:, dimension, None]
        lower, upper = tube.lower[:, None] + shift + narrowing, tube.upper[:, None] + shift - narrowing
        return Tube(torch.minimum(lower, upper), torch.maximum(lower, upper))

    def select(self, index: Tensor) -> Halves:
        """The same for some of the cells, in the given order."""
        return Halves(self.shift[index], self.narrowing[index])

    @staticmethod
    def join(parts: Sequence[Halves | None]) -> Halves | None:
        """One after the other; None if one of them is."""
        known = [p for p in parts if p is not None]
        if len(known) < len(parts):
            return None
        return Halves(torch.cat([p.shift for p in known]), torch.cat([p.narrowing for p in known]))
