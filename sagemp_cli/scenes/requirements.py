"""What a loop in continuous time must do: stay in a box, keep out of one, keep a relation between its states, and when.

All of them reduce to one form, a :class:`Formula`: functions of the state whose values must not be negative, all of
them or at least one of them, at every time of an interval.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from sagemp_cli.errors import UsageError, did_you_mean
from sagemp_cli.scenes.scene import Ball, Block, Scene
from sagemp_cli.sets import Box

Bounds = Mapping[str | int, tuple[float, float]]
"""By name or number of a state, its least and its greatest value, infinite where there is none."""

When = Literal["always", "end"] | tuple[float, float]
"""All times, the last one, or from one time to another one in seconds, both included."""


@dataclass(frozen=True, eq=False)
class Formula:
    """Margins ``g_1(x), ..., g_c(x)`` that hold at every time of an interval.

    Attributes:
        name: for messages.
        margins: ``(..., n)`` to ``(..., c)``, in torch operations.
        every: whether all margins must hold, or at each time one of them at least.
        strict: whether a margin must be above 0, or 0 will do.
        first, last: seconds; infinite for the end of the horizon.
    """

    name: str
    margins: Callable[[Any], Any]
    every: bool
    strict: bool
    first: float
    last: float

    def holds(self, margin: Tensor) -> Tensor:
        """Whether margins are large enough; NaN is not."""
        return margin > 0 if self.strict else margin >= 0


@dataclass(frozen=True)
class Inside:
    """States lie within bounds.

    Attributes:
        bounds: see :data:`Bounds`; states that it does not name are free.
        when: see :data:`When`.
        name: for messages.
    """

    bounds: Bounds
    when: When = "always"
    name: str = "inside"

    def formula(self, state_names: Sequence[str]) -> Formula:
        """The general form, for states of these names."""
        return Formula(
            self.name, _faces(self.bounds, state_names, self.name, 1.0), True, False, *_times(self.when, self.name)
        )


@dataclass(frozen=True)
class Outside:
    """States never lie within all of the bounds at once.

    Attributes:
        bounds: of the box, which is closed; see :data:`Bounds`. It is endless in states that it does not name.
        when: see :data:`When`.
        name: for messages.
    """

    bounds: Bounds
    when: When = "always"
    name: str = "outside"

    def formula(self, state_names: Sequence[str]) -> Formula:
        """The general form, for states of these names."""
        return Formula(
            self.name, _faces(self.bounds, state_names, self.name, -1.0), False, True, *_times(self.when, self.name)
        )


@dataclass(frozen=True)
class Holds:
    """A relation between states: the values of a function are never negative.

    Attributes:
        margins: of states ``(..., n)``, values ``(..., c)``, in torch operations that can be bounded.
        when: see :data:`When`.
        name: for messages.
        strict: whether 0 is too little.
    """

    margins: Callable[[Any], Any]
    when: When = "always"
    name: str = "relation"
    strict: bool = False

    def formula(self, state_names: Sequence[str]) -> Formula:
        """The general form."""
        return Formula(self.name, self.margins, True, self.strict, *_times(self.when, self.name))


Requirement = Inside | Outside | Holds


def of_scene(scene: Scene, position: Sequence[int]) -> tuple[Requirement, ...]:
    """What a scene asks for: within the workspace and clear of obstacles always, in the goal at the end."""
    found: list[Requirement] = []
    if scene.workspace.has_faces:
        found.append(Inside(_of_box(scene.workspace, position), name="workspace"))
    for obstacle in scene.obstacles:
        if isinstance(obstacle, Block):
            found.append(Outside(_bounds(obstacle.lower, obstacle.upper, position), name=obstacle.name))
        else:
            found.append(
                Holds(functools.partial(_distance, obstacle, tuple(position)), name=obstacle.name, strict=True)
            )
    if scene.goal.has_faces:
        found.append(Inside(_of_box(scene.goal, range(scene.goal.dim)), when="end", name="goal"))
    return tuple(found)


def _of_box(box: Box, states: Sequence[int]) -> Bounds:
    return _bounds(box.lower.tolist(), box.upper.tolist(), states)


def _bounds(lower: Sequence[float], upper: Sequence[float], states: Sequence[int]) -> Bounds:
    return {i: (low, high) for i, low, high in zip(states, lower, upper, strict=True)}


def _distance(ball: Ball, position: tuple[int, ...], x: Any) -> Any:
    """From the ball's surface, negative inside."""
    away = [x[..., i : i + 1] - c for i, c in zip(position, ball.center, strict=True)]
    return torch.sqrt(functools.reduce(torch.add, [a**2 for a in away])) - ball.radius


def _faces(bounds: Bounds, state_names: Sequence[str], name: str, sign: float) -> Callable[[Any], Any]:
    """Distances from the faces of a box, positive inside; outside if the sign is -1."""
    rows, limits = [], []
    for state, sides in bounds.items():
        i = _state(state, state_names, name)
        try:
            low, high = (float(side) for side in sides)
        except (TypeError, ValueError):
            raise UsageError(f"requirement '{name}': state {state} needs two numbers, found {sides!r}") from None
        if not low <= high:
            raise UsageError(f"requirement '{name}': state {state} needs a least and a greatest value, found {sides}")
        for side, towards in ((low, sign), (high, -sign)):
            if math.isfinite(side):
                rows.append([towards * (j == i) for j in range(len(state_names))])
                limits.append(-towards * side)
    if not rows:
        raise UsageError(f"requirement '{name}' bounds no state")
    weight, bias = (torch.tensor(part, dtype=torch.float64) for part in (rows, limits))
    return lambda x: torch.nn.functional.linear(x, weight, bias)


def _state(given: str | int, names: Sequence[str], name: str) -> int:
    if isinstance(given, str) and given in names:
        return names.index(given)
    if isinstance(given, int) and not isinstance(given, bool) and 0 <= given < len(names):
        return given
    near = did_you_mean(str(given), names) or f"; known: {', '.join(names)}"
    raise UsageError(f"requirement '{name}' speaks of state {given!r}, which the loop does not have{near}")


def _times(when: Any, name: str) -> tuple[float, float]:
    """First and last second."""
    if when in ("always", "end"):
        return (0.0 if when == "always" else math.inf, math.inf)
    try:
        first, last = (float(t) for t in when)
    except (TypeError, ValueError):
        raise UsageError(f"requirement '{name}': when is 'always', 'end' or two times, found {when!r}") from None
    if not 0 <= first <= last:
        raise UsageError(f"requirement '{name}': when needs a time of at least 0 and a later one, found {when!r}")
    return first, last
