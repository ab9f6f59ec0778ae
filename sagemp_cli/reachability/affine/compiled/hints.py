"""What a pass knows from an earlier one: bounds of the operations' inputs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from sagemp_cli.errors import UsageError
from sagemp_cli.reachability.relaxations.arctangent2 import Turn


class Hint(NamedTuple):
    """What is known from an earlier pass of one operation's input.

    Attributes:
        name, size: of the operation that it is known of, and of one cell's entries.
        lower, upper: bounds of the input; None if there are none.
        turn: of an angle, the direction across which its input was.
    """

    name: str
    size: int
    lower: Tensor | None = None
    upper: Tensor | None = None
    turn: Turn | None = None

    def intersected(self, other: Hint) -> Hint:
        """What holds if both hold; the other one, if they are not of the same input."""
        same_turn = all(map(torch.equal, self.turn or (), other.turn or ())) and (not self.turn) == (not other.turn)
        if self.lower is None or self.upper is None or self[:2] != other[:2] or not same_turn:
            return other
        if other.lower is None or other.upper is None:
            return self
        return self._replace(lower=torch.maximum(self.lower, other.lower), upper=torch.minimum(self.upper, other.upper))


Hints = Sequence[Hint]
"""What is known of every operation of a step, in the order of evaluation."""


def hint_of(hints: Hints | None, name: str, size: int, before: Sequence[tuple[str, int]]) -> Hint | None:
    """What is known of the operation that comes after these.

    Raises:
        UsageError: the step does other operations than when the hints were found: they may be bounds of other values.
    """
    if hints is None:
        return None
    now, then = [*before, (name, size)], [(h.name, h.size) for h in hints[: len(before) + 1]]
    if now != then:
        found, was = (", ".join(f"{n} of {s}" for n, s in names) for names in (now, then))
        raise UsageError(
            f"the loop's step does not always do the same operations: {found}, where it did {was} in an earlier pass"
        )
    return hints[len(before)]
