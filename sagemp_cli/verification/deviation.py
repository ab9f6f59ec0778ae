"""Tubes of the analytical model that a learned robot stands for: its deviation from that model, folded into w.

Let ``e(x, u)`` be what w has to be changed by for the learned model to make the analytical model's step,
``step(x, u, w + e(x, u)) = step*(x, u, w)`` (:meth:`~sagemp_cli.dynamics.learned.Learned.compared`). At every step a
bound of ``e`` is taken over the set of states reached so far, with the controls that the loop then gives, and the
disturbance box of that step is enlarged by it; what ``e`` has to do with the state is given up. A tube that is made
like this encloses every rollout of the analytical loop under W, by induction over k: ``x_k`` lies in its set, so
``e(x_k, u_k)`` lies within its bound, and ``w_k + e`` is one of the disturbances under which the learned model was
followed to the set of step k+1.

The bound is taken on the affine forms of the step itself: states, controls and both models' derivatives keep their
correlation there, in each cell by itself. It is rigorous, rounding included, and its own excess over the true deviation
is of second order in the width of the set: small cells pay.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from sagemp_cli.dynamics.learned import Learned
from sagemp_cli.errors import UsageError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.form import Form, Operation
from sagemp_cli.reachability.propagator import Footprint, Loop, LoopSize, Propagator, Reach
from sagemp_cli.reachability.relaxations.band import Band, settled
from sagemp_cli.reachability.relaxations.functions import functions_of
from sagemp_cli.reachability.relaxations.lines import Lines
from sagemp_cli.sets import Box
from sagemp_cli.sets.rounding import TINY, UNIT
from sagemp_cli.verification.verification import Verification

FOLDED = "identity"
"""Name under which folding is recorded: the identity function, relaxed by a constant."""


@dataclass(frozen=True)
class Folded(Propagator):
    """Forward affine arithmetic on a learned robot's loop with the deviation folded into w.

    Its tubes are those of the analytical model. What others give as bounds of
    the controls ``(*batch, K, m)`` here has ``m + n`` columns, the controls and then ``e``; :func:`split` takes them
    apart.

    Attributes:
        affine: the propagator.
    """

    affine: Affine
    name: ClassVar[str] = Affine.name
    rigorous: ClassVar[bool] = True

    def reach(self, loop: Loop, start: Box, disturbance: Box, *, watch: bool = False) -> Reach:
        """See :class:`~sagemp_cli.reachability.propagator.Propagator`.

        Raises:
            UsageError: the robot is not a learned one.
        """
        if not isinstance(loop, ClosedLoop) or not isinstance(loop.dynamics, Learned):
            found = type(loop.dynamics if isinstance(loop, ClosedLoop) else loop).__name__
            raise UsageError(f"only a learned robot deviates from a model, found {found}")
        return self.affine.reach(_FoldingLoop(loop), start, disturbance, watch=watch)

    def footprint(self, size: LoopSize) -> Footprint:
        """That of the affine propagator."""
        return self.affine.footprint(size)


@dataclass(frozen=True)
class _FoldingLoop:
    """A closed loop that folds as it steps; what is watched are controls and deviations."""

    loop: ClosedLoop
    given_dim: ClassVar[int] = ClosedLoop.given_dim

    @property
    def horizon(self) -> int:
        return self.loop.horizon

    @property
    def state_dim(self) -> int:
        return self.loop.state_dim

    def given(self, k: int) -> Tensor:
        return self.loop.given(k)

    def step_given(self, given: Tensor, x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
        robot = self.loop.dynamics
        u = self.loop.control_given(given, x)
        derivative, deviation = robot.compared(x, u)
        return robot.advance(x, derivative, w + folded(deviation)), torch.cat([u, deviation], dim=-1)

    def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
        return self.step_given(self.given(k), x, w)[0]


def folded(value: Form) -> Form:
    """A value of which only its bounds are kept."""
    return value.relaxed(FOLDED, _KEEPS_BOUNDS)


def _band(lower: Any, upper: Any) -> Band:
    """A constant band; of tensors or of arrays."""
    center = 0.5 * (lower + upper)
    radius = functions_of(lower).maximum(upper - center, center - lower) * (1.0 + 4 * UNIT) + TINY
    return settled(0.0 * center, center, radius)


def _lines(lower: Tensor, upper: Tensor) -> Lines:
    level = torch.zeros_like(lower)
    return Lines(level, lower, level, upper)


_KEEPS_BOUNDS = Operation(_band, _lines, lambda lower, upper: (lower, upper), arrays=True)


def split(found: Verification, controls: int) -> tuple[Verification, Tensor]:
    """A verification made by :class:`Folded` as others are, and bounds of ``|e|`` over its tubes, ``(R, K, n)``."""
    lower, upper = found.control_lower, found.control_upper
    deviation = torch.maximum(-lower[..., controls:], upper[..., controls:])
    plain = dataclasses.replace(found, control_lower=lower[..., :controls], control_upper=upper[..., :controls])
    return plain, deviation
