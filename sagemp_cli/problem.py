"""What a proof speaks about: robot, scene, sets, horizon."""

from __future__ import annotations

from dataclasses import dataclass

from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.scenes.scene import Scene
from sagemp_cli.sets import Between, Box


@dataclass(frozen=True)
class Problem:
    """Everything that a proof speaks about except the reference and the tracker.

    Attributes:
        dynamics: the robot.
        scene: safe set and goal.
        start: X_I, ``(n,)``; ``(R, n)`` where each of R references has its own.
        disturbance: W, ``(d,)``.
        horizon: number of steps K.
        between: whether the safe set is to be kept over the whole of every step: along straight lines in discrete time,
            at all times in continuous time. It is for every robot here; a stranger's loop may be no such motion.
    """

    dynamics: Dynamics
    scene: Scene
    start: Box
    disturbance: Box
    horizon: int
    between: Between = Between.SEGMENTS

    @property
    def unknowns(self) -> Box:
        """What is unknown of every step: :meth:`~sagemp_cli.dynamics.base.Dynamics.unknowns`."""
        return self.dynamics.unknowns(self.disturbance)
