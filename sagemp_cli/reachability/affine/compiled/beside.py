"""Where a step's forms are told what intervals know: wherever that makes a noticeable difference."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from sagemp_cli.reachability.affine.compiled.folding import Node
from sagemp_cli.reachability.relaxations.functions import functions_of

Sides = tuple[Any, Any]
"""Lower and upper bounds, ``(B, entries)`` each."""

KINKED = ("relu", "leaky_relu", "clamp", "abs")
ONE_KINK = ("relu", "leaky_relu")
"""Functions that are linear on either side of 0: of which side it is nothing more has to be known."""
NOTICEABLE_AT_A_KINK, NOTICEABLE = 0.9, 0.65
"""What part of a form's width an operand's interval has at most where it is worth the time: errors at a kink are of
first order in that width, those of all else of second."""
ROUNDING, VANISHING = 1e-10, 1e-200
"""A width this small, relative to the values or absolutely, may be rounding only."""


class Beside:
    """What intervals know of the operands of one step.

    In a cell it is used from the first operation on of which an operand's interval is noticeably tighter than its form;
    so a cell's set does not depend on the cells beside it.

    Args:
        cells: in which it is used from the beginning, ``(B,)``.
        noticing: whether it is used elsewhere too, as soon as it makes a difference.

    Attributes:
        cells: in which it has been used.
        noticing: as given.
    """

    def __init__(self, cells: Any, *, noticing: bool) -> None:
        self.cells, self.noticing = cells, noticing
        self._node: Node | None = None
        self._known: Sides | None = None

    def turn(self, node: Node, operands: tuple[np.ndarray, np.ndarray]) -> None:
        """Which operation is next, and the intervals of its operands."""
        self._node, self._known = node, operands

    def sharpened(self, lower: Any, upper: Any) -> Sides:
        """Bounds of the first operands by their forms, and by intervals where these are used."""
        assert self._node is not None and self._known is not None
        m = functions_of(lower)
        low, high = (side[:, : lower.shape[-1]] for side in self._known)
        if not isinstance(lower, np.ndarray):
            low, high = torch.from_numpy(low), torch.from_numpy(high)
        low, high = m.fmax(lower, low), m.fmin(upper, high)  # what is no number says nothing
        if self.noticing:
            self.cells = self.cells | noticeably(self._node, lower, upper, low, high)
        where = self.cells[:, None]
        return m.where(where, low, lower), m.where(where, high, upper)


def noticeably(node: Node, lower: Any, upper: Any, low: Any, high: Any) -> Any:
    """In which cells the second bounds of an operand, within the first, are noticeably tighter anywhere, ``(B,)``."""
    if node.rule == "sums":  # what float32 adds to them is not worth it
        return np.zeros(len(lower), dtype=bool)
    kinked = node.relaxation is not None and node.relaxation.name in KINKED
    part = NOTICEABLE_AT_A_KINK if kinked else NOTICEABLE
    width, its = upper - lower, high - low
    tighter = its < width * part
    if not tighter.any():
        return tighter.any(-1)
    doubt = ROUNDING * (abs(lower) + abs(upper)) + VANISHING
    tighter = its < width * part - doubt
    if node.rule == "function" and node.relaxation is not None and node.relaxation.name in ONE_KINK:
        tighter = tighter & (lower < 0) & (upper > 0)
    return tighter.any(-1)
