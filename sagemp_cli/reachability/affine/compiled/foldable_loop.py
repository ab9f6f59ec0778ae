"""Which loops can be folded, and when one that offers it is not."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

from torch import Tensor


class NotFoldable(Exception):
    """A step does something that needs the sets themselves; it has to be evaluated operation by operation."""


@runtime_checkable
class FoldableLoop(Protocol):
    """A loop whose steps are the same but for some numbers.

    ``step_given`` is evaluated once for all sets, so it must not look at values, and its dimensions count from the end:
    there may be any batch in front.

    Attributes:
        given_dim: dimensions of these, without batch.
    """

    given_dim: int

    def given(self, k: int) -> Tensor:
        """The numbers of step k, ``(..., any shape)``."""

    def step_given(self, given: Tensor, x: Tensor, w: Tensor) -> tuple[Tensor, Tensor | None]:
        """The next state ``(..., n)`` and, where there is one, the control (or what else is to be bounded)."""


def speaks_for_itself(loop: Any) -> bool:
    """Whether a loop's ``step_given`` says what its ``step`` does: whether none of its classes came later with another
    ``step`` or ``control``.
    """
    kinds = type(loop).__mro__
    last = next((i for i, kind in enumerate(kinds) if "step_given" in vars(kind)), None)
    if last is None or any(name in getattr(loop, "__dict__", {}) for name in ("step", "control")):
        return False
    return not any(name in vars(kind) for kind in kinds[:last] for name in ("step", "control"))
