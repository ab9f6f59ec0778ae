"""A rollout replayed in rigorous arithmetic: what it certainly breaks, whatever float64 makes of it.

Far from the origin, and where a claim is missed by a hair, the rounding of a rollout in float64 is larger than the
violation that it shows. So a rollout refutes a claim only if affine arithmetic, which encloses every rounding error
and lets the feedback contract it, puts the whole state at some step outside of what is claimed.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.problem import Problem
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.propagator import Loop
from sagemp_cli.sets import Box, round_down, round_up


@dataclass(frozen=True)
class OneRollout:
    """A loop under one sequence of disturbances ``(K, d)``; the disturbance that a step is given is left aside."""

    loop: Loop
    disturbances: Tensor

    @property
    def horizon(self) -> int:
        """Number of steps K."""
        return self.loop.horizon

    @property
    def state_dim(self) -> int:
        """Number of states n."""
        return self.loop.state_dim

    def step(self, k: int, x: Tensor, w: Tensor) -> Tensor:
        """``x_{k+1}`` under the disturbance of step k."""
        return self.loop.step(k, x, self.disturbances[k])


def inner(box: Box) -> Box:
    """What a box certainly holds of the real one whose corners were rounded outwards to make it.

    Rounding to nearest and one float outwards (:meth:`~sagemp_cli.sets.box.Box.around`) moves a corner by less than
    two floats. A dimension that is narrower than that, where nothing is certain, is left as it is.
    """
    low, high = round_up(round_up(box.lower)), round_down(round_down(box.upper))
    fits = low <= high
    return Box(torch.where(fits, low, box.lower), torch.where(fits, high, box.upper))


def violations(loop: Loop, start: Tensor, disturbances: Tensor, problem: Problem) -> Tensor:
    """Which constraint the rollout certainly breaks at which step, ``(K+1, C)``: [workspace, obstacles..., goal].

    Args:
        loop: what steps.
        start: ``(n,)``, in :func:`inner` of X_I. In a dimension so narrow that its inner points are not known the
            start is anywhere in it.
        disturbances: ``(K, d)``, in :func:`inner` of W; if W has so narrow a dimension, nothing is certain.
        problem: what is claimed, with X_I ``(n,)``; the loop may be another one than that of its robot.
    """
    scene, around = problem.scene, problem.start
    loose, loose_w = _unknown(around), _unknown(problem.disturbance)
    rows, columns = loop.horizon + 1, len(scene.constraint_names) + 1
    if bool(loose_w.any()):
        return torch.zeros(rows, columns, dtype=torch.bool)
    first = Box(torch.where(loose, around.lower, start), torch.where(loose, around.upper, start))
    still = Box.around([0.0] * problem.disturbance.dim, [0.0] * problem.disturbance.dim)
    tube = Affine().propagate(OneRollout(loop, disturbances), first, still)
    position = list(problem.dynamics.position)
    p = Box(tube.lower[:, position], tube.upper[:, position])
    outside = ((p.lower > scene.workspace.upper) | (p.upper < scene.workspace.lower)).any(-1)
    missed = torch.zeros(rows, dtype=torch.bool)
    missed[-1] = ((tube.lower[-1] > scene.goal.upper) | (tube.upper[-1] < scene.goal.lower)).any()
    return torch.stack([outside, *(o.occupies(p) for o in scene.obstacles), missed], dim=-1)


def _unknown(box: Box) -> Tensor:
    """Dimensions that are neither points nor wide enough to have certain inner points."""
    return (box.lower < box.upper) & (round_up(round_up(box.lower)) > round_down(round_down(box.upper)))
