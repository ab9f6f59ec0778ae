"""What a planner is to the rest of the project: something that samples references."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, Protocol, runtime_checkable

import torch
from torch import Tensor

from sagemp_cli.errors import NonFiniteError, UsageError
from sagemp_cli.scenes.scene import Scene
from sagemp_cli.sets import Box
from sagemp_cli.training import Loss


@runtime_checkable
class Planner(Protocol):
    """Anything that samples references; a file of trajectories is a planner too.

    Nothing else is assumed of it: not that it learns, not that its plans are feasible, safe or even near the
    goal. What a plan is worth is found out by verification.
    """

    def sample(self, start: Tensor, goal: Box, *, scene: Scene, count: int, generator: torch.Generator) -> Tensor:
        """Sample references ``(count, K+1, n)``, float64, states at the robot's time step, row 0 the start.

        Args:
            start: one state ``(n,)`` from which all ``count`` references start, or ``(count, n)``, one each.
            goal: the set of goal states; a planner trained for one goal may ignore it.
            scene: what a planner that looks at obstacles needs; others ignore it.
            count: how many references.
            generator: the source of all randomness: the same state gives the same references.
        """


class LearnedPlanner(Planner, Protocol):
    """A planner that is an ``nn.Module`` and learns from demonstrations.

    ``type(planner)(**planner.arguments)`` and ``load_state_dict(planner.state_dict())`` rebuild it.

    Attributes:
        loss_type: called as ``loss_type(planner, demonstrations, steps=..., **options)`` after :meth:`prepare`;
            gives the loss of the training loop. Its signature says which options there are.
        state_dim: number of states n.
        horizon: number of steps K.
        arguments: constructor arguments as plain data.
    """

    loss_type: ClassVar[Callable[..., Loss]]
    state_dim: int
    horizon: int

    @property
    def arguments(self) -> dict[str, Any]:
        """Constructor arguments as plain data."""

    def prepare(self, demonstrations: Tensor, *, generator: torch.Generator) -> None:
        """Take from demonstrations ``(D, K+1, n)`` what is not learned by descent, and draw initial weights."""


def starts_of(start: Tensor, *, count: int, state_dim: int) -> Tensor:
    """The starts ``(count, n)``, float64, that the argument ``start`` of :meth:`Planner.sample` stands for.

    Raises:
        UsageError: ``start`` is neither ``(n,)`` nor ``(count, n)``, or ``count`` is not positive.
        NonFiniteError: a start is NaN or infinite.
    """
    if count < 1:
        raise UsageError(f"the number of references must be positive, found {count}")
    if tuple(start.shape) not in ((state_dim,), (count, state_dim)):
        raise UsageError(
            f"start must have shape ({state_dim},) or ({count}, {state_dim}) for {count} references, "
            f"found {tuple(start.shape)}"
        )
    if not bool(torch.isfinite(start).all()):
        raise NonFiniteError("a start contains NaN or infinity")
    return start.to(torch.float64).expand(count, state_dim).clone()
