"""The paper's propagator: CROWN bounds of the unrolled closed loop, computed by auto_LiRPA (section V-C).

It is the method to compare with, not the certificate: it computes in plain float64, rounding is not enclosed.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from sagemp_cli.errors import ConfigError, UnsupportedOperationError
from sagemp_cli.reachability.batch import recorded_and_batched
from sagemp_cli.reachability.lirpa.adapter import METHODS, bound
from sagemp_cli.reachability.program.kinds import FLOAT32
from sagemp_cli.reachability.propagator import Loop, Propagator, Reach
from sagemp_cli.sets import Box, Tube

MODES = ("one_shot", "one_step", "n_step")


@dataclass(frozen=True)
class AutoLirpa(Propagator):
    """Tubes from backward CROWN; cells are one batch, references are done one after the other.

    One-shot walks back from every intermediate node of every step to the start, so its time grows with the square of
    the horizon. The other modes forget, every step or every ``steps`` steps, all but a box: faster and looser.

    Attributes:
        mode: ``one_shot`` (the paper's: every step's state is bounded over the whole unrolled graph), ``one_step``
            (a box after each step) or ``n_step`` (a box after every ``steps`` steps).
        steps: length of a piece in mode ``n_step``.
        method: ``CROWN`` or ``IBP`` (intervals).
    """

    mode: Literal["one_shot", "one_step", "n_step"] = "one_shot"
    steps: int = 10
    method: str = "CROWN"
    name: ClassVar[str] = "auto_lirpa"
    rigorous: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise ConfigError(f"auto_lirpa: mode must be one of {', '.join(MODES)}, found '{self.mode}'")
        if self.method not in METHODS:
            raise ConfigError(f"auto_lirpa: method must be one of {', '.join(METHODS)}, found '{self.method}'")
        if self.steps < 1:
            raise ConfigError(f"auto_lirpa: steps must be a positive integer, found {self.steps}")

    def reach(self, loop: Loop, start: Box, disturbance: Box, *, watch: bool = False) -> Reach:
        """See :class:`~sagemp_cli.reachability.propagator.Propagator`; controls and recordings it has none.

        Raises:
            UnsupportedOperationError: the loop uses an operation that auto_LiRPA cannot bound or bounds wrongly.
            UsageError: no usable auto_LiRPA is installed, or the boxes do not fit the loop.
        """
        known, start = recorded_and_batched(loop, start, disturbance)
        if any(kind in FLOAT32 for program in known.programs for kind in program.kinds):
            raise UnsupportedOperationError(
                "auto_lirpa does not enclose float32 arithmetic; use affine, crown, best or interval"
            )
        batch, n = start.lower.shape[:-1], start.dim
        lower, upper = (corner.reshape(-1, n) for corner in (start.lower, start.upper))
        # Cells often come with a copy of their reference each: equal references make one call.
        numbers = known.numbers_in(batch).detach().movedim(0, -2).reshape(len(lower), known.horizon, -1)
        each, which = torch.unique(numbers.flatten(1), dim=0, return_inverse=True) if numbers.numel() else _one(lower)
        low = torch.empty(len(lower), known.horizon + 1, n, dtype=torch.float64)
        high = torch.empty_like(low)
        for r in range(len(each)):
            mine = which == r
            one = dataclasses.replace(known, numbers=each[r].reshape(known.horizon, known.numbers.shape[-1]))
            low[mine], high[mine] = self._cells(one, Box(lower[mine], upper[mine]), disturbance)
        return Reach(Tube(low.reshape(*batch, -1, n), high.reshape(*batch, -1, n)))

    def _cells(self, loop: Loop, start: Box, disturbance: Box) -> tuple[Tensor, Tensor]:
        """Tube corners ``(cells, K+1, n)`` of cells ``(cells, n)`` under one reference."""
        horizon, n = loop.horizon, loop.state_dim
        piece = {"one_shot": horizon, "one_step": 1, "n_step": self.steps}[self.mode]
        low = torch.full((start.lower.shape[0], horizon + 1, n), -torch.inf, dtype=torch.float64)
        high = torch.full_like(low, torch.inf)
        low[:, 0], high[:, 0] = start.lower, start.upper
        for first in range(0, horizon, piece):
            # A cell that has overflown stays infinite; the others go on.
            alive = (torch.isfinite(low[:, first]) & torch.isfinite(high[:, first])).all(-1)
            if not bool(alive.any()):
                break
            count = min(piece, horizon - first)
            states = self._piece(loop, Box(low[alive, first], high[alive, first]), disturbance, first, count)
            low[alive, first + 1 : first + 1 + count] = states.lower.unflatten(-1, (count, n))
            high[alive, first + 1 : first + 1 + count] = states.upper.unflatten(-1, (count, n))
        return low, high

    def _piece(self, loop: Loop, start: Box, disturbance: Box, first: int, count: int) -> Box:
        """Boxes ``(cells, count n)`` of the states after steps ``first .. first + count - 1``, in one graph."""

        def unrolled(x: Tensor, *disturbances: Tensor) -> Tensor:
            states = []
            for k, w in enumerate(disturbances, start=first):
                x = loop.step(k, x, w)
                states.append(x)
            return torch.cat(states, dim=-1)

        cells = start.lower.shape[0]
        one = Box(disturbance.lower.expand(cells, -1), disturbance.upper.expand(cells, -1))
        return bound(unrolled, [start, *[one] * count], method=self.method)


def _one(cells: Tensor) -> tuple[Tensor, Tensor]:
    """Steps without numbers are one group."""
    return torch.zeros(1, 0, dtype=torch.float64), torch.zeros(len(cells), dtype=torch.int64)
