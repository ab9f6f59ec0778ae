"""What is kept of a step for a backward pass."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sagemp_cli.reachability.affine.compiled.operations import Frame, Relaxed, Value
from sagemp_cli.sets.rounding import TINY

Array = np.ndarray

GENERATORS = 24
"""Generators that are kept of a set, per state."""


class KeptStep(NamedTuple):
    """A step of arrays without its generators, which would be most of it.

    Attributes:
        relaxed: the operations, in the order of evaluation.
        own_radius: radii of all variables but the states, ``(variables - n,)``.
        within: generators of a set that the state's deviations lie in, few of them, ``(B, n, m)``.
        ellipsoid: the shape matrix of the symbols, scaled to the extent of the set's box, ``(B, n, n)``; no enclosure,
            but enough where a guess is.
        after: the next state.
        rounding: what it is off by, in terms of the variables, ``(B, n)``.
    """

    relaxed: list[Relaxed]
    own_radius: Array
    within: Array
    ellipsoid: Array
    after: Value
    rounding: Array

    @staticmethod
    def of(frame: Frame, after: Value) -> KeptStep:
        """What is kept of a step."""
        states = frame.states
        square = states.generators @ np.swapaxes(states.generators, -1, -2)
        scale = states.reach / (np.sqrt(np.diagonal(square, axis1=-2, axis2=-1)) + TINY)
        ellipsoid = square * scale[..., None] * scale[..., None, :]
        own = frame.own_radius[: frame.size - states.dim]
        within = states.reduce_order(GENERATORS * states.dim)[0].generators
        return KeptStep(frame.relaxed, own, within, ellipsoid, after, frame.rounding(after))
