"""Stored tubes against obstacles that were moved, added or removed: a test that propagates nothing (paper, V-E).

A tube does not depend on the scene; whether it is clear of one does. The boxes over the parts of all steps are the
leaves of a tree whose nodes are the hulls of eight children each (a bounding volume hierarchy over time). A node that
is clear of an obstacle settles all of its leaves, so that of tubes x steps x obstacles only those pairs are looked at
that come near each other.

What is called clear is clear, rounding included: comparisons of a block's faces are exact, and the distance to a ball
is compared with a margin for the roundings of its square, see :func:`_from_balls`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sagemp_cli.scenes.scene import Ball, Block, Scene
from sagemp_cli.sets import Box
from sagemp_cli.sets.rounding import TINY, gamma

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

FACTOR = 8
"""Children of a node. A step has eight parts: the nodes above the leaves are steps."""


@dataclass(frozen=True)
class BoundingVolumes:
    """The trees of T tubes.

    Attributes:
        lower, upper: of each level, from the leaves to one node per tube, ``(d, T * nodes)``: those of a tube in turn.
        nodes: nodes of one tube at each level, each :data:`FACTOR` times those of the level above.
    """

    lower: tuple[Array, ...]
    upper: tuple[Array, ...]
    nodes: tuple[int, ...]

    @classmethod
    def of(cls, over: Box) -> BoundingVolumes:
        """From boxes ``(T, P, d)`` over all the parts of all steps."""
        low, high = over.lower.numpy(), over.upper.numpy()
        levels = 0
        while FACTOR ** (levels + 1) <= low.shape[1]:
            levels += 1
        whole = -(-low.shape[1] // FACTOR**levels) * FACTOR**levels
        low, high = _padded(low, whole, np.inf), _padded(high, whole, -np.inf)
        sides = [(low, high)]
        for _ in range(levels):
            low = low.reshape(len(low), -1, FACTOR, low.shape[2]).min(2)
            high = high.reshape(len(high), -1, FACTOR, high.shape[2]).max(2)
            sides.append((low, high))
        nodes = [low.shape[1] for low, _ in sides]
        flat = [tuple(np.ascontiguousarray(s.reshape(-1, s.shape[2]).T) for s in pair) for pair in sides]
        return cls(tuple(a for a, _ in flat), tuple(b for _, b in flat), tuple(nodes))

    def __len__(self) -> int:
        return self.lower[-1].shape[1] // self.nodes[-1]

    def clear(self, scene: Scene) -> NDArray[np.bool_]:
        """Whether each tube is certainly inside the workspace and clear of all obstacles, at all times, ``(T,)``."""
        low, high = (side[-1].reshape(len(side[-1]), len(self), -1) for side in (self.lower, self.upper))
        inside = np.ones(len(self), dtype=np.bool_)
        for i in range(len(low)):
            inside &= (low[i] > float(scene.workspace.lower[i])).all(-1)
            inside &= (high[i] < float(scene.workspace.upper[i])).all(-1)
        for gaps in (
            _from_balls([o for o in scene.obstacles if isinstance(o, Ball)]),
            _from_blocks([o for o in scene.obstacles if isinstance(o, Block)]),
        ):
            if gaps is not None:
                self._settle(inside, gaps)
        return inside

    def _settle(self, clear: NDArray[np.bool_], gaps: _Gaps) -> None:
        """Take from ``clear (T,)`` the tubes of which a leaf is not clear of all obstacles."""
        top = len(self.nodes) - 1
        tubes = np.flatnonzero(clear)
        node = (tubes[:, None] * self.nodes[top] + np.arange(self.nodes[top])).reshape(-1).repeat(gaps.count)
        which = np.tile(np.arange(gaps.count), len(tubes) * self.nodes[top])
        for level in range(top, -1, -1):
            gap = self._gap(gaps, level, node, which)
            near = ~(gap > 0)
            node, which, gap = node[near], which[near], gap[near]
            tube = node // self.nodes[level]
            if level == 0:
                clear[tube] = False
            elif len(node):
                self._dive(clear, gaps, level, node, which, gap)
                left = clear[tube]
                node = (node[left][:, None] * FACTOR + np.arange(FACTOR)).reshape(-1)
                which = which[left].repeat(FACTOR)

    def _dive(
        self, clear: NDArray[np.bool_], gaps: _Gaps, level: int, node: Indices, which: Indices, gap: Array
    ) -> None:
        """Of each tube follow the nearest pair to a leaf: where that touches, no other pair has to be looked at."""
        tube = node // self.nodes[level]
        order = np.lexsort((gap, tube))
        first = order[np.flatnonzero(np.diff(tube[order], prepend=-1))]
        tube, node, which = tube[first], node[first], which[first]
        for below in range(level - 1, -1, -1):
            children = node[:, None] * FACTOR + np.arange(FACTOR)
            gap = self._gap(gaps, below, children.reshape(-1), which.repeat(FACTOR)).reshape(-1, FACTOR)
            nearest = gap.argmin(1)[:, None]
            node, gap = np.take_along_axis(children, nearest, 1)[:, 0], np.take_along_axis(gap, nearest, 1)[:, 0]
        clear[tube[~(gap > 0)]] = False

    def _gap(self, gaps: _Gaps, level: int, node: Indices, which: Indices) -> Array:
        return gaps.of(self.lower[level].take(node, axis=1), self.upper[level].take(node, axis=1), which)


@dataclass(frozen=True)
class _Gaps:
    """Something that is positive only if a box is clear of an obstacle.

    Attributes:
        count: number of obstacles.
        of: of boxes ``(d, N)`` and indices of obstacles ``(N,)``, ``(N,)``; comparable for one obstacle only.
    """

    count: int
    of: Callable[[Array, Array, Indices], Array]


def _from_balls(balls: Sequence[Ball]) -> _Gaps | None:
    """The square of the distance less that of the radius.

    A gap is one subtraction, correctly rounded, and 0 where it is not positive; of a sum of d squares every term has
    at most ``2 + 1 + d`` roundings, and the square of the radius one. What underflows is far below :data:`TINY`. The
    last subtraction has the right sign.
    """
    if not balls:
        return None
    center, radius = np.array([b.center for b in balls]).T, np.array([b.radius for b in balls])
    limit = radius * radius * (1.0 + 2 * gamma(len(center) + 8)) + TINY

    def of(low: Array, high: Array, which: Indices) -> Array:
        total = np.zeros(len(which))
        for i, c in enumerate(center):
            at = c[which]
            gap = np.maximum(np.maximum(low[i] - at, at - high[i]), 0.0)
            total += gap * gap
        return total - limit[which]

    return _Gaps(len(balls), of)


def _from_blocks(blocks: Sequence[Block]) -> _Gaps | None:
    """The largest gap along an axis; a difference has the right sign."""
    if not blocks:
        return None
    lower, upper = np.array([b.lower for b in blocks]).T, np.array([b.upper for b in blocks]).T

    def of(low: Array, high: Array, which: Indices) -> Array:
        gap = np.full(len(which), -np.inf)
        for i in range(len(lower)):
            gap = np.fmax(gap, np.fmax(low[i] - upper[i][which], lower[i][which] - high[i]))  # inf - inf says nothing
        return gap

    return _Gaps(len(blocks), of)


def _padded(values: Array, count: int, value: float) -> Array:
    """Rows ``(T, P, d)`` and, up to ``count``, rows of a value: those of empty boxes, which nothing touches."""
    return np.concatenate([values, np.full((len(values), count - values.shape[1], values.shape[2]), value)], 1)
