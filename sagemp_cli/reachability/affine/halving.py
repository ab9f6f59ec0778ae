"""What would become of a zonotope's generators if one side of the start box were halved: followed through the steps.

A side's own generator is halved. The error of an operation is, near enough, of second order in its operand's width: if
that falls to ``1 - r`` of itself the error falls to ``(1 - r)^2``; at a kink too, since only one of the halves has it.
An operand's width falls by the shares of all generators in it, so what halving each side takes off every generator
follows the operations in their order, as the generators do. Only a guess hangs on it: there are few generators here,
those that matter least being put together, and nothing is rounded outwards.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from sagemp_cli.reachability.affine.compiled.operations import Frame, Relaxed, Value
from sagemp_cli.reachability.halves import Halves
from sagemp_cli.sets import Box

MOST = 96
"""Generators that are followed, at most, beside those of a step."""


class Halving:
    """Follows the steps of a pass on arrays.

    Args:
        start: the cells, ``(B, n)``.

    Attributes:
        shifts, narrowings: of every step so far, ``(B, n, n)``; see :class:`~sagemp_cli.reachability.halves.Halves`.
    """

    def __init__(self, start: Box) -> None:
        radius = start.radius.detach().numpy()
        cells, n = radius.shape
        self._generators = radius[:, :, None] * np.eye(n)  # those of the sides stay the first
        self._shares = np.broadcast_to(0.5 * np.eye(n), (cells, n, n)).copy()  # of each, by each side's halving
        self.shifts: list[np.ndarray] = []
        self.narrowings: list[np.ndarray] = []
        self._note()

    def copy(self) -> Halving:
        """One that does not change with this."""
        made = object.__new__(Halving)
        made._generators, made._shares = self._generators, self._shares
        made.shifts, made.narrowings = list(self.shifts), list(self.narrowings)
        return made

    @np.errstate(all="ignore")
    def follow(self, frame: Frame, after: Value) -> None:
        """A step."""
        (cells, n, _), size = self._generators.shape, after.coefficients.shape[-1]
        own = frame.own_radius if frame.own_radius.ndim == 1 else frame.own_radius[:, 0]
        radius = np.broadcast_to(own[..., : size - n], (cells, size - n))
        shares = np.zeros((cells, size - n, n))
        for r in frame.relaxed:
            first = r.first - n
            if first < size - n:
                shares[:, first : first + r.radius.shape[-1]] = 1.0 - self._left(r, radius, shares)
        fresh = after.coefficients[..., n:] * radius[:, None]
        old = after.coefficients[..., :n] @ self._generators
        self._generators = np.concatenate([old, fresh], -1)
        self._shares = np.concatenate([self._shares, shares], 1)
        self._note()
        self._put_together()

    def halves(self, horizon: int) -> Halves:
        """Of so many steps, at those that were not followed nothing."""
        sides = (np.stack(steps, 2) for steps in (self.shifts, self.narrowings))
        known = (torch.from_numpy(np.nan_to_num(side, posinf=0.0, neginf=0.0)) for side in sides)
        return Halves(*(torch.nn.functional.pad(s, (0, 0, 0, horizon + 1 - s.shape[2])) for s in known))

    def _left(self, r: Relaxed, radius: np.ndarray, shares: np.ndarray) -> Any:
        """What is left of an operation's errors, ``(B, e, n)``."""
        if r.factors is not None:
            return self._width(r.factors.x, radius, shares) * self._width(r.factors.y, radius, shares)
        return self._width(r.form.coefficients, radius, shares) ** 2

    def _width(self, coefficients: Any, radius: np.ndarray, shares: np.ndarray) -> np.ndarray:
        """What is left of the width of values of the step."""
        n, known = self._generators.shape[1], coefficients.shape[-1]
        of_states = np.abs(coefficients[..., :n] @ self._generators)
        of_own = np.abs(coefficients[..., n:]) * radius[:, None, : known - n]
        gone = of_states @ self._shares + of_own @ shares[:, : known - n]
        width = of_states.sum(-1) + of_own.sum(-1)
        return 1.0 - gone / np.maximum(width, 1e-300)[..., None]

    def _note(self) -> None:
        n = self._generators.shape[1]
        self.shifts.append(0.5 * np.swapaxes(self._generators[..., :n], 1, 2))
        self.narrowings.append(np.swapaxes(np.abs(self._generators) @ self._shares, 1, 2))

    def _put_together(self) -> None:
        """Of more generators than are followed the least, to one along each axis."""
        size = np.abs(self._generators)
        cells, n, count = size.shape
        if count <= MOST + 2 * n:
            return
        weight = (size / np.maximum(size.sum(-1, keepdims=True), 1e-300)).sum(1)
        weight[:, :n] = np.inf
        order = np.argsort(-weight, axis=1)
        kept, others = np.sort(order[:, :MOST], axis=1), order[:, MOST:]
        rest = np.take_along_axis(size, others[:, None], -1)
        box = rest.sum(-1)
        shares = (rest @ np.take_along_axis(self._shares, others[..., None], 1)) / np.maximum(box, 1e-300)[..., None]
        self._generators = np.concatenate(
            [np.take_along_axis(self._generators, kept[:, None], -1), box[..., None] * np.eye(n)], -1
        )
        self._shares = np.concatenate([np.take_along_axis(self._shares, kept[..., None], 1), shares], 1)
