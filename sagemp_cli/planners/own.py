"""Anybody's planner: a function or an object with ``sample``, whose plans are checked and nothing else asked of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from sagemp_cli.errors import NonFiniteError, UsageError
from sagemp_cli.planners.base import starts_of
from sagemp_cli.scenes.scene import Scene
from sagemp_cli.sets import Box

AT_THE_START = 1e-6
"""How far row 0 may lie from the start, relative to it: what float32 rounds off."""


class OwnPlanner(nn.Module):
    """A planner that learns nothing here, wrapped so that it can be kept in a file.

    It is called as ``planner(start, goal, scene=..., count=..., generator=...)`` with starts ``(count, n)`` and gives
    plans ``(count, K+1, n)``, a tensor or an array. What it gives is checked each time.

    Args:
        planner: the function, or an object whose method ``sample`` is one. Weights of a module are kept.
        name: in messages.
        state_names: names of the n states.
        horizon: number of steps K.
    """

    learns_from: ClassVar[str] = "nothing"

    def __init__(self, planner: Any, *, name: str, state_names: Sequence[str], horizon: int) -> None:
        super().__init__()
        call: Any = getattr(planner, "sample", planner)
        if not callable(call):
            raise UsageError(f"planner '{name}' is neither a function nor an object with a method 'sample'")
        self.planner, self.name = planner, name
        self.state_names, self.horizon = tuple(state_names), horizon
        self._call: Callable[..., Any] = call

    @property
    def arguments(self) -> dict[str, Any]:
        """None: it is built again from the config."""
        return {}

    def sample(self, start: Tensor, goal: Box, *, scene: Scene, count: int, generator: torch.Generator) -> Tensor:
        """References ``(count, K+1, n)``, see :class:`~sagemp_cli.planners.base.Planner`.

        Raises:
            UsageError: it fails, or gives something of another shape, or plans that start elsewhere.
            NonFiniteError: a plan contains NaN or infinity.
        """
        starts = starts_of(start, count=count, state_dim=len(self.state_names))
        try:
            plans = self._call(starts, goal, scene=scene, count=count, generator=generator)
            plans = torch.as_tensor(plans).detach().to(torch.float64)
        except UsageError:
            raise
        except Exception as e:
            raise UsageError(f"planner '{self.name}': {type(e).__name__}: {e}") from e
        wanted = (count, self.horizon + 1, len(self.state_names))
        if tuple(plans.shape) != wanted:
            raise UsageError(
                f"planner '{self.name}' must give plans of shape (count, K+1, n) = {wanted}, found {tuple(plans.shape)}"
            )
        if not bool(torch.isfinite(plans).all()):
            i, k, j = (~torch.isfinite(plans)).nonzero()[0].tolist()
            raise NonFiniteError(
                f"planner '{self.name}': plan {i} has {float(plans[i, k, j])} for {self.state_names[j]} at step {k}"
            )
        apart = (plans[:, 0] - starts).abs()
        if bool((apart > AT_THE_START * (1 + starts.abs())).any()):
            i, j = divmod(int(apart.argmax()), len(self.state_names))
            raise UsageError(
                f"planner '{self.name}': plan {i} begins with {self.state_names[j]} = {float(plans[i, 0, j]):g}, "
                f"the start has {float(starts[i, j]):g}; row 0 of a plan is the start that it was asked for"
            )
        return plans
