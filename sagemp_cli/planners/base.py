"""What a planner is to the rest of the project: something that samples references."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, Protocol, runtime_checkable

import torch
from torch import Tensor

from sagemp_cli.errors import NonFiniteError, UsageError
from sagemp_cli.learning.checkpoint import Resumable
from sagemp_cli.learning.fit import History, Loss
from sagemp_cli.progress import Progress
from sagemp_cli.scenes.scene import Scene
from sagemp_cli.sets import Box


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
        ...


@runtime_checkable
class Proposer(Planner, Protocol):
    """A planner that generates the start too, and then moves its plans onto it.

    ``sample(start, ...)`` is ``settle(propose(start, ...), start)``: apart, they show how far off the start was.
    """

    def propose(self, start: Tensor, goal: Box, *, scene: Scene, count: int, generator: torch.Generator) -> Tensor:
        """Plans ``(count, K+1, n)`` that begin near the start."""
        ...

    def settle(self, plans: Tensor, start: Tensor) -> Tensor:
        """The plans moved onto their starts ``(n,)`` or ``(count, n)``, without a jump."""
        ...


class StoredPlanner(Planner, Protocol):
    """A planner that is an ``nn.Module`` and can be kept in a file.

    ``type(planner)(**planner.arguments)`` and ``load_state_dict(planner.state_dict())`` rebuild it.

    Attributes:
        learns_from: what it is trained with. ``"demonstrations"``: see :class:`LearnedPlanner`; ``"scenes"``: see
            :class:`SelfTaughtPlanner`; ``"nothing"``: it is complete as it is built.
        arguments: constructor arguments as plain data.
    """

    learns_from: ClassVar[str]

    @property
    def arguments(self) -> dict[str, Any]:
        """Constructor arguments as plain data."""
        ...


class LearnedPlanner(StoredPlanner, Protocol):
    """A planner that learns from demonstrations: its ``learns_from`` is ``"demonstrations"``.

    Attributes:
        loss_type: called as ``loss_type(planner, demonstrations, steps=..., **options)`` after :meth:`prepare`;
            gives the loss of the training loop. Its signature says which options there are.
        state_dim: number of states n.
        horizon: number of steps K.
    """

    loss_type: ClassVar[Callable[..., Loss]]
    state_dim: int
    horizon: int

    def prepare(self, demonstrations: Tensor, *, goal: Box, generator: torch.Generator) -> None:
        """Take from demonstrations ``(D, K+1, n)`` what is not learned by descent, and draw initial weights."""


class SelfTaughtPlanner(StoredPlanner, Protocol):
    """A planner that makes its own lessons: its ``learns_from`` is ``"scenes"``.

    Attributes:
        options_type: the dataclass that the config's ``planner_training`` becomes.
    """

    options_type: ClassVar[type]

    def learn(
        self,
        options: Any,
        *,
        scene: Scene,
        generator: torch.Generator,
        resumable: Resumable | None,
        progress: Progress | None,
    ) -> History:
        """Train in place; ``options`` are of :attr:`options_type`, the others as in :mod:`sagemp_cli.learning.fit`."""
        ...


def affordable(planner: Planner, wanted: int) -> int:
    """How many plans may be asked for just to look at them: ``wanted``, or fewer where the planner says so.

    A planner whose plans cost a request each has an attribute ``affordable_plans``.
    """
    return max(1, min(wanted, getattr(planner, "affordable_plans", wanted)))


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
