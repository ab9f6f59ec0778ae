"""What is proved of a loop in continuous time between its instants."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Ge
from torch import Tensor

from sagemp_cli.errors import UsageError
from sagemp_cli.sets import Box, Bulge, Tube, round_up


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
class AskedDivision:
    """How a period is to be cut and how far the flow is to be expanded.

    Attributes:
        substeps: equal parts, a power of two; None: as many as are needed.
        order: degree of the Taylor polynomials; None: what serves most loops.
    """

    substeps: Annotated[int, Ge(1)] | None = None
    order: Annotated[int, Ge(1)] | None = None


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
        jump: of a control that lags, how much the rate changes with it at the beginning of every part; else 0.
        measured_lower, measured_upper: of a control that lags, what is left out of the state that was measured, S is 1;
            else 0.
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
    jump: Tensor
    measured_lower: Tensor
    measured_upper: Tensor

    def select(self, index: Tensor) -> Flow:
        """The same for some of the cells, in the given order."""
        return Flow(self.division, *(side[index] for side in self._sides()))

    def known_until(self, period: Tensor) -> Flow:
        """The same, with nothing known from some period ``(C,)`` of each cell on."""
        lost = (torch.arange(self.lower.shape[1]) >= period[:, None])[..., None, None]
        signs, sides = (-1, 1, -1, 1, -1, 1, 1, 1), self._sides()
        bounds = (torch.where(lost, sign * torch.inf, side) for sign, side in zip(signs, sides, strict=False))
        return Flow(self.division, *bounds, *sides[len(signs) :])  # what is known of a lag says nothing by itself

    def lines(self, tube: Tube, w: Box, period: float) -> tuple[Tube, Bulge]:
        """Boxes at the ends of all parts, ``(C, K S + 1, n)``, and how far solutions leave the straight lines between.

        Args:
            tube: at the instants, ``(C, K+1, n)``.
            w: W, ``(n,)`` or for each period ``(K, n)``.
            period: seconds.
        """
        ends = [
            torch.cat([side.flatten(1, 2), of_tube[:, -1:]], 1)
            for side, of_tube in zip((self.state_lower, self.state_upper), (tube.lower, tube.upper), strict=True)
        ]
        parts = self.division.substeps
        swing = round_up(2 * period / parts * w.radius).expand(self.lower.shape[1], -1).repeat_interleave(parts, 0)
        if bool((self.jump != 0).any()):
            jump = torch.where(self.jump >= 0, self.jump, torch.inf)  # NaN too bounds nothing
            swing = round_up(swing + round_up(period / parts * jump.flatten(1, 2)))
        rest = round_up(2 * self.drift.flatten(1, 2))
        return Tube(*ends), Bulge(self.curve.flatten(1, 2), swing, rest)

    def arrays(self) -> dict[str, Tensor]:
        """All of it by name."""
        division = torch.tensor([self.division.substeps, self.division.order])
        names = [field.name for field in dataclasses.fields(self)[1:]]
        return {"division": division} | dict(zip(names, self._sides(), strict=True))

    @staticmethod
    def of(arrays: Mapping[str, Tensor]) -> Flow:
        """Back from :meth:`arrays`.

        Raises:
            KeyError: an array is missing.
        """
        substeps, order = arrays["division"].tolist()
        return Flow(Division(substeps, order), *(arrays[field.name] for field in dataclasses.fields(Flow)[1:]))

    def padded(self, periods: int) -> Flow:
        """The same with so many periods more, of which nothing is said yet."""
        return Flow(self.division, *(torch.nn.functional.pad(s, (0, 0, 0, 0, 0, periods)) for s in self._sides()))

    @staticmethod
    def join(parts: Sequence[Flow | None], dim: int = 0) -> Flow | None:
        """One after the other, of cells (0) or of periods (1); None if one of them is.

        Raises:
            UsageError: they are not divided alike.
        """
        known = [part for part in parts if part is not None]
        if len(known) < len(parts):
            return None
        counts = sorted({part.division.substeps for part in known})
        if len(counts) > 1:
            raise UsageError(
                f"references need their periods cut into {' and '.join(map(str, counts))} parts; one number has to "
                f"serve all: proof.substeps={counts[-1]}"
            )
        sides = zip(*(part._sides() for part in known), strict=True)
        return Flow(known[0].division, *(torch.cat(side, dim) for side in sides))

    def _sides(self) -> list[Tensor]:
        return [getattr(self, field.name) for field in dataclasses.fields(self)[1:]]
