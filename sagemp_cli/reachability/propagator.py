"""What a propagator is: closed loop + box of starts + box of disturbances -> reach set."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Protocol

from torch import Tensor

from sagemp_cli.reachability.flow import Flow
from sagemp_cli.reachability.halves import Halves
from sagemp_cli.reachability.recording import Recording
from sagemp_cli.sets import Box, Tube


class Loop(Protocol):
    """Anything that steps: our :class:`~sagemp_cli.loop.closed_loop.ClosedLoop` or a stranger's loop."""

    @property
    def horizon(self) -> int:
        """Number of steps K."""
        ...

    @property
    def state_dim(self) -> int:
        """Number of states n."""
        ...

    def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
        """``x_{k+1}`` from ``x_k (..., n)`` and ``w_k (..., d)``, written in torch operations."""
        ...


@dataclass(frozen=True)
class Reach:
    """What a propagator found; all but the tube may be missing.

    Attributes:
        tube: contains every rollout, ``(..., K+1, n)``.
        control_lower, control_upper: bounds of the controls per step, ``(..., K, m)``.
        recording: what a certificate keeps of the proof.
        notes: what whoever reads the tube should know, one line each.
        flow: of a loop in continuous time, what was proved between the instants.
        halves: what halving each cell would do, foreseen.
    """

    tube: Tube
    control_lower: Tensor | None = None
    control_upper: Tensor | None = None
    recording: Recording | None = None
    notes: tuple[str, ...] = ()
    flow: Flow | None = None
    halves: Halves | None = None


@dataclass(frozen=True)
class LoopSize:
    """What the memory of a propagator depends on.

    Attributes:
        steps: K.
        states: n.
        disturbances: d.
        entries: of the nonlinear operations of a step, E.
        widest: entries of the operation that has most, H.
        controls: m columns of bounds beside the states; 0 if the loop does not say its controls.
    """

    steps: int
    states: int
    disturbances: int
    entries: int
    widest: int
    controls: int = 0

    @staticmethod
    def of(recording: Recording, steps: int, states: int, disturbances: int, controls: int = 0) -> LoopSize:
        """Of a loop of which one step, or more, was recorded."""
        entries, widest = recording.slope.shape[-1], max(recording.widths, default=1)
        return LoopSize(steps, states, disturbances, entries, widest, controls)

    @property
    def variables(self) -> int:
        """Of a step: its states, its disturbances and one per relaxed entry, ``v = n + d + E``."""
        return self.states + self.disturbances + self.entries

    @property
    def bounds(self) -> int:
        """Numbers of one cell's tube and bounds of controls."""
        return 2 * (self.steps + 1) * self.states + 2 * self.steps * self.controls


@dataclass(frozen=True)
class Footprint:
    """Bytes of one cell.

    Attributes:
        working: while it is bounded, given up afterwards; None if nothing is known of it.
        kept: of what was found.
    """

    working: float | None
    kept: float


NUMBER = 8
"""Bytes of a float64."""


class Propagator(ABC):
    """Bounds every rollout of a loop. Its options are its constructor's.

    Attributes:
        name: the word in configs and artifacts.
        rigorous: whether rounding is included in the enclosure, or it is sound in exact arithmetic only.
    """

    name: ClassVar[str]
    rigorous: ClassVar[bool]

    @abstractmethod
    def reach(self, loop: Loop, start: Box, disturbance: Box, *, watch: bool = False) -> Reach:
        """A tube that contains every rollout from ``start (..., n)`` under every sequence of disturbances in
        ``disturbance (d,)``; its row 0 is the start box.

        Leading dimensions are batch (cells, references) and broadcast against those of the loop. A tube that overflows
        has infinite rows, it is no error.

        Args:
            loop, start, disturbance: what is bounded.
            watch: whether the controls and a recording are wanted too, if this propagator can give them.

        Raises:
            UsageError: boxes that do not fit the loop; or the loop overrides the step that says its controls.
            UnsupportedOperationError: the loop does what this propagator cannot bound.
        """

    def propagate(self, loop: Loop, start: Box, disturbance: Box) -> Tube:
        """The tube alone, see :meth:`reach`."""
        return self.reach(loop, start, disturbance).tube

    def footprint(self, size: LoopSize) -> Footprint:
        """Bytes of arrays that one cell takes, at most."""
        return Footprint(None, NUMBER * size.bounds)
