"""The cheapest way over a map: what turns the stand-in's maps into a handful of waypoints."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import zoom
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

Array = NDArray[np.float64]

SIDE = 48
"""Cells of the search grid per side of the square from -1 to 1."""
BLOCKED_COST = 40.0
"""A cell that surely must not be entered costs this many times a free one: entered only where there is no other way."""
NOISE_CELLS = 5
"""The random preference is drawn on a grid this coarse, so that it decides between sides and not between cells."""
SHARPEST = -0.5
"""Cosine of the sharpest turn over the place to pass over: a way that turns back there is drawn anew."""
TRIES = 6

_MOVES = [(i, j) for i in range(-2, 3) for j in range(-2, 3) if (i, j) != (0, 0) and np.gcd(i, j) == 1]


def waypoints_on(
    blocked: Array, over: Array, start: Array, goal: Array, *, temperature: float, rng: np.random.Generator
) -> Array:
    """Waypoints ``(J, 2)`` between start and goal, as few as the way needs, at least one.

    Args:
        blocked: chance that a place must not be entered, ``(h, h)`` over the square from -1 to 1, top row first.
        over: chance that a place is what to pass over, the same shape.
        start, goal: places ``(2,)`` in the square.
        temperature: strength of a random, smooth preference; 0 gives the cheapest way, about 1 other sides as well.
        rng: source of the preference.
    """
    wall, target = np.clip(_finer(blocked), 0.0, 1.0), _middle(_finer(over))
    tries = 0
    while True:
        taste = np.exp(temperature * _finer(rng.normal(size=(NOISE_CELLS, NOISE_CELLS)), order=3))
        cost = (1.0 + BLOCKED_COST * wall) * taste
        to = _straightened(_cheapest(cost, start, goal if target is None else target), wall)
        if target is None:
            return np.stack(to) if to else 0.5 * (start + goal)[None]
        on = _straightened(_cheapest(cost, target, goal), wall)
        way = np.stack([start, *to, target, *on, goal])
        before, after = np.diff(way[len(to) : len(to) + 3], axis=0)
        tries += 1
        if tries == TRIES or before @ after > SHARPEST * np.linalg.norm(before) * np.linalg.norm(after):
            return way[1:-1]


def _finer(coarse: Array, order: int = 1) -> Array:
    """A map on the search grid; values are those of cells, at their middles."""
    exact = np.asarray(coarse, dtype=np.float64)
    fine = zoom(exact, SIDE / len(coarse), order=order, mode="nearest", grid_mode=True)
    assert fine.shape == (SIDE, SIDE)
    return np.asarray(fine, dtype=np.float64)


def _middle(over: Array) -> Array | None:
    """The middle of the places that are more likely than not what to pass over, None where there are none."""
    sure = np.where(over > 0.5, over, 0.0)
    if not sure.any():
        return None
    rows, columns = np.indices(over.shape)
    weights = sure / sure.sum()
    return _place((weights * rows).sum(), (weights * columns).sum())


def _place(row: float, column: float) -> Array:
    return np.array([(column + 0.5) * 2 / SIDE - 1, 1 - (row + 0.5) * 2 / SIDE])


def _cells(places: Array) -> NDArray[np.int64]:
    """Indices of the cells of places ``(..., 2)`` into the flattened grid; places outside count to the edge."""
    column = np.clip((places[..., 0] + 1) * (SIDE / 2), 0, SIDE - 1).astype(np.int64)
    return np.clip((1 - places[..., 1]) * (SIDE / 2), 0, SIDE - 1).astype(np.int64) * SIDE + column


def _cheapest(cost: Array, start: Array, goal: Array) -> Array:
    """The cheapest chain of places from start to goal, both ends included; moves are king's and knight's moves."""
    index = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
    sources, targets, prices = [], [], []
    for i, j in _MOVES:
        here = (slice(max(0, -i), SIDE - max(0, i)), slice(max(0, -j), SIDE - max(0, j)))
        there = (slice(max(0, i), SIDE + min(0, i)), slice(max(0, j), SIDE + min(0, j)))
        sources.append(index[here].ravel())
        targets.append(index[there].ravel())
        prices.append((np.hypot(i, j) * 0.5 * (cost[here] + cost[there])).ravel())
    edges = (np.concatenate(prices), (np.concatenate(sources), np.concatenate(targets)))
    graph = csr_array(edges, shape=(SIDE * SIDE, SIDE * SIDE))
    first, last = int(_cells(start)), int(_cells(goal))
    _, before = dijkstra(graph, indices=first, return_predecessors=True)
    chain = [last]
    while chain[-1] != first:
        chain.append(int(before[chain[-1]]))
    between = [_place(*divmod(cell, SIDE)) for cell in chain[-2:0:-1]]
    return np.stack([start, *between, goal])


def _straightened(chain: Array, wall: Array) -> list[Array]:
    """The places of a chain where it turns: from each, straight on as far as the line is no worse than the chain."""
    worst = wall.ravel()[_cells(chain)]
    share = np.linspace(0, 1, 2 * SIDE)[:, None, None]
    kept, here = [], 0
    while here < len(chain) - 1:
        lines = chain[here] + share * (chain[here + 1 :] - chain[here])
        on_lines = wall.ravel()[_cells(lines)].max(0)
        passable = on_lines <= np.maximum(0.3, np.maximum.accumulate(np.maximum(worst[here + 1 :], worst[here])))
        passable[0] = True
        here += 1 + int(np.flatnonzero(passable)[-1])
        kept.append(chain[here])
    return kept[:-1]
