"""What is proved of a loop in continuous time between its instants."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Division:
    """How a period is cut and how far the flow is expanded.

    Attributes:
        substeps: equal parts of the period S, a power of two.
        order: degree of the Taylor polynomials p.
    """

    substeps: int
    order: int


@dataclass(frozen=True)
class Flow:
    """Of C cells over K periods of S parts each; infinite where nothing was found. All arrays are ``(C, K, S, n)``.

    Attributes:
        division: substeps and order.
        state_lower, state_upper: at the beginning of every part.
        lower, upper: boxes that no solution leaves within the part.
        remainder_lower, remainder_upper: what the Taylor polynomial leaves out lies here.
        curve: bound of ``h^2 / 2 |z''|`` of the solutions z under a constant disturbance, h the length of a part.
        drift: how far a solution is from that under a mean of its disturbance, but for the integrals of both.
    """

    division: Division
    state_lower: Tensor
    state_upper: Tensor
    lower: Tensor
    upper: Tensor
    remainder_lower: Tensor
    remainder_upper: Tensor
    curve: Tensor
    drift: Tensor

    def select(self, index: Tensor) -> Flow:
        """The same for some of the cells, in the given order."""
        return Flow(self.division, *(side[index] for side in self._sides()))

    def known_until(self, period: Tensor) -> Flow:
        """The same, with nothing known from some period ``(C,)`` of each cell on."""
        lost = (torch.arange(self.lower.shape[1]) >= period[:, None])[..., None, None]
        signs = (-1, 1, -1, 1, -1, 1, 1, 1)
        sides = zip(signs, self._sides(), strict=True)
        return Flow(self.division, *(torch.where(lost, sign * torch.inf, side) for sign, side in sides))

    def padded(self, periods: int) -> Flow:
        """The same with so many periods more, of which nothing is said yet."""
        return Flow(self.division, *(torch.nn.functional.pad(s, (0, 0, 0, 0, 0, periods)) for s in self._sides()))

    @staticmethod
    def join(parts: Sequence[Flow], dim: int = 0) -> Flow:
        """One after the other, of cells (0) or of periods (1)."""
        sides = zip(*(part._sides() for part in parts), strict=True)
        return Flow(parts[0].division, *(torch.cat(side, dim) for side in sides))

    def _sides(self) -> list[Tensor]:
        return [getattr(self, field.name) for field in dataclasses.fields(self)[1:]]
