"""What a propagator is: closed loop + box of starts + box of disturbances -> tube."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from sagemp_cli.sets import Box, Tube


class Loop(Protocol):
    """Anything that steps: our :class:`~sagemp_cli.loop.closed_loop.ClosedLoop` or a stranger's loop."""

    @property
    def horizon(self) -> int:
        """Number of steps K."""

    @property
    def state_dim(self) -> int:
        """Number of states n."""

    def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
        """``x_{k+1}`` from ``x_k (..., n)`` and ``w_k (..., d)``, written in torch operations."""


class Propagator(Protocol):
    """Bounds every rollout of a loop.

    Attributes:
        name: the word in configs and artifacts.
        rigorous: whether rounding is included in the enclosure, or it is sound in exact arithmetic only.
    """

    name: str
    rigorous: bool

    def propagate(self, loop: Loop, start: Box, disturbance: Box) -> Tube:
        """Tubes ``(..., K+1, n)`` that contain every rollout from ``start (..., n)`` under every sequence of
        disturbances in ``disturbance (d,)``; row 0 is the start box. Leading dimensions are batch (cells,
        references) and broadcast against those of the loop. A tube that overflows has infinite rows, it is no error.
        """
