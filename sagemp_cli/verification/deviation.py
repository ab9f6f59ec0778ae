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
from typing import ClassVar

import torch
from torch import Tensor

from sagemp_cli.dynamics.learned import Learned
from sagemp_cli.errors import UsageError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.program.arithmetic import identity
from sagemp_cli.reachability.propagator import Footprint, Loop, LoopSize, Propagator, Reach
from sagemp_cli.sets import Box
from sagemp_cli.verification.verification import Verification


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
        return self.affine.reach(ComparedLoop(loop), start, disturbance, watch=watch)

    def footprint(self, size: LoopSize) -> Footprint:
        """That of the affine propagator."""
        return self.affine.footprint(size)


@dataclass(frozen=True)
class ComparedLoop:
    """A learned robot's closed loop whose disturbance is enlarged by what the robot deviates from its model.

    Attributes:
        loop: of the learned robot.
    """

    loop: ClosedLoop

    @property
    def horizon(self) -> int:
        """Number of steps K."""
        return self.loop.horizon

    @property
    def state_dim(self) -> int:
        """Number of states n."""
        return self.loop.state_dim

    def numbers(self) -> Tensor:
        """What each step has of its own, ``(K, ..., g)``."""
        return self.loop.numbers()

    def step_given(self, numbers: Tensor, x: Tensor, w: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The next state, the control and the deviation; a proof keeps of the last no more than its bounds."""
        robot = self.loop.dynamics
        assert isinstance(robot, Learned)
        u = self.loop.control_given(numbers, x)
        derivative, deviation = robot.compared(x, u)
        return robot.advance(x, derivative, w + identity(deviation)), u, deviation

    def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
        """``x_{k+1}`` of the analytical model."""
        return self.step_given(self.numbers()[k], x, w)[0]


def split(found: Verification, controls: int) -> tuple[Verification, Tensor]:
    """A verification made by :class:`Folded` as others are, and bounds of ``|e|`` over its tubes, ``(R, K, n)``."""
    lower, upper = found.control_lower, found.control_upper
    deviation = torch.maximum(-lower[..., controls:], upper[..., controls:])
    plain = dataclasses.replace(found, control_lower=lower[..., :controls], control_upper=upper[..., :controls])
    return plain, deviation
