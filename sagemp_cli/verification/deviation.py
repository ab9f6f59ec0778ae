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

from dataclasses import dataclass

from torch import Tensor

from sagemp_cli.dynamics.learned import Learned
from sagemp_cli.errors import UsageError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.reachability.program.arithmetic import identity


@dataclass(frozen=True)
class ComparedLoop(ClosedLoop):
    """A learned robot's closed loop whose disturbance is enlarged by what the robot deviates from its model: exactly
    the model's loop under the same tracker.

    Its tubes are those of the analytical model. What others give as bounds of the controls ``(*batch, K, m)`` here has
    ``m + n`` columns, the controls and then ``e``.

    Raises:
        UsageError: the robot is not a learned one.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.dynamics, Learned):
            raise UsageError(f"only a learned robot deviates from a model, found {type(self.dynamics).__name__}")

    def after(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        """The analytical model's next state under a control."""
        return self._compared(x, u, w)[0]

    def step_given(self, numbers: Tensor, x: Tensor, w: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The next state, the control and the deviation; a proof keeps of the last no more than its bounds."""
        u = self.control_given(numbers, x)
        after, deviation = self._compared(x, u, w)
        return after, u, deviation

    def _compared(self, x: Tensor, u: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
        robot = self.dynamics
        assert isinstance(robot, Learned)
        derivative, deviation = robot.compared(x, u)
        return robot.advance(x, derivative, w + identity(deviation)), deviation
