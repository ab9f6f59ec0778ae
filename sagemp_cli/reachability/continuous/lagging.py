"""How much of every part of a period a control that lags may leave to the one before; ``docs/continuous_time.md``.

Of a part of length h the control before is in force for a share s of it first, ``s (2 - s)`` and ``s^2`` of its means
weighted towards its beginning and its end.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import torch
from torch import Tensor

from sagemp_cli.reachability.flow import Division
from sagemp_cli.sets import Box

LOOSE = 2.0**-40
"""More than what is rounded in a share."""


@dataclass(frozen=True)
class Shares:
    """Of K periods and the first L parts of each, which the delay may reach into.

    Attributes:
        least, most: bounds of s, ``(K, L)``; 0 in the first period of a loop.
        means: of the weights of both means, the last dimension, ``(K, L, 2)``; likewise.
        jitter: bounds of the seconds that a measurement is older, ``(K,)``.
    """

    least: Tensor
    most: Tensor
    means: Box
    jitter: tuple[Tensor, Tensor]

    @property
    def parts(self) -> int:
        """L."""
        return self.most.shape[1]

    @staticmethod
    def of(lag: Box, first: int, stop: int, period: float, division: Division) -> Shares:
        """Of periods from ``first`` on, before ``stop``; period 0 has no lag.

        Args:
            lag: bounds of delay and jitter, ``(2,)`` or of every period of the loop ``(K, 2)``.
            first, stop: which periods.
            period: seconds.
            division: how it is cut.
        """
        there = (torch.arange(first, stop) > 0)[:, None]
        sides = (lag.lower, lag.upper)
        low, high = (s.expand(stop - first, 2) if s.dim() == 1 else s[first:stop] for s in sides)
        h = period / division.substeps
        begins = torch.arange(lagged_parts(lag, period, division), dtype=torch.float64) * h
        least, most = (((side[:, :1] - begins) / h).clamp(0.0, 1.0) for side in (low, high))
        lower = (torch.stack([least * (2 - least), least * least], -1) - LOOSE).clamp(min=0.0)
        upper = (torch.stack([most * (2 - most), most * most], -1) + LOOSE).clamp(max=1.0)
        shares = ((least - LOOSE).clamp(min=0.0), (most + LOOSE).clamp(max=1.0))
        masked = [torch.where(there, s.flatten(1), 0.0) for s in (*shares, lower, upper, low[:, 1:], high[:, 1:])]
        means = Box(*(side.unflatten(1, (most.shape[1], 2)) for side in masked[2:4]))
        return Shares(masked[0], masked[1], means, (masked[4][:, 0], masked[5][:, 0]))

    def since(self, period: float, substeps: int) -> int:
        """The first part of a period that what is measured at its end may be of."""
        most = float(self.jitter[1].max())
        return max(j for j in range(substeps) if j == 0 or j * (period / substeps) <= (period - most) * (1 - LOOSE))

    @property
    def swing(self) -> Tensor:
        """Bound of ``int |k| / h^2`` over a part, k the integral of what is in force less its mean, ``(K, L)``."""
        early = torch.minimum(torch.full_like(self.most, 1 / 11), self.most / 2)
        return torch.minimum(early, (1 - self.least) ** 2) * (1 + LOOSE)


def lagged_parts(lag: Box | None, period: float, division: Division) -> int:
    """Parts of a period that the delay may reach into, L."""
    if lag is None:
        return 0
    h, most = Fraction(period) / division.substeps, Fraction(float(lag.upper[..., 0].max()))
    return sum(1 for j in range(division.substeps) if j * h < most)


def has_jitter(lag: Box | None) -> bool:
    """Whether a measurement may be older than its instant."""
    return lag is not None and float(lag.upper[..., 1].max()) > 0
