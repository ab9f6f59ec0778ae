"""Scenes of three dimensions in perspective: room, obstacles, goal, tubes and paths."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from sagemp_cli.problem import Problem
from sagemp_cli.report.canvas import GOAL, HAIRLINE, INK, MUTED, OBSTACLE, REFERENCE, TIME, shown_steps, state_label
from sagemp_cli.scenes import Ball
from sagemp_cli.storage import Tubes

_FACES = np.array([[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]])
"""Corners of each face; bit 2 of a corner's number is its x side, bit 1 y, bit 0 z."""
_BITS = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)], dtype=bool)
_LIGHT = np.array([-0.5, -0.6, 0.8]) / np.linalg.norm([-0.5, -0.6, 0.8])


def space_axes(figure: Figure, place: SubplotSpec, problem: Problem) -> Axes3D:
    """Axes with the scene to scale: the room's edges, shaded obstacles, the goal box."""
    axes = figure.add_subplot(place, projection="3d", computed_zorder=False)
    low, high = problem.scene.workspace.lower.numpy(), problem.scene.workspace.upper.numpy()
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.03)  # pyright: ignore[reportArgumentType]  (declared as a whole number)
    axes.view_init(elev=24, azim=-62)
    labels = [state_label(problem, i) for i in problem.dynamics.position]
    sides: tuple[Any, ...] = (axes.xaxis, axes.yaxis, axes.zaxis)  # Matplotlib declares the axes of the plane for these
    for axis, label in zip(sides, labels, strict=True):
        axis.set_pane_color("white")
        axis.line.set_color(MUTED)
        axis.set_label_text(label, fontsize=9.5, color=INK)
        axis._axinfo["grid"].update(color=HAIRLINE, linewidth=0.6)  # no public way to a quiet grid in 3-D
    axes.tick_params(colors=MUTED, labelsize=8)
    for obstacle in problem.scene.obstacles:
        if isinstance(obstacle, Ball):
            _sphere(axes, np.array(obstacle.center), obstacle.radius)
            at = np.array(obstacle.center)
        else:
            faces = box_faces(np.array([obstacle.lower]), np.array([obstacle.upper]))
            axes.add_collection3d(Poly3DCollection(faces, facecolor=OBSTACLE, edgecolor="white", linewidth=0.3))
            at = (np.array(obstacle.lower) + np.array(obstacle.upper)) / 2
        axes.text(at[0], at[1], at[2], obstacle.name, color="white", fontsize=8, ha="center", va="center", zorder=2.5)
    index = list(problem.dynamics.position)
    goal = [np.clip(v.numpy()[index], low, high) for v in (problem.scene.goal.lower, problem.scene.goal.upper)]
    faces = box_faces(goal[0][None], goal[1][None])
    axes.add_collection3d(Poly3DCollection(faces, facecolor=GOAL, alpha=0.1, edgecolor=GOAL, linewidth=1.3, zorder=6))
    middle = 0.5 * (goal[0] + goal[1])
    axes.text(middle[0], middle[1], goal[1][2] + 0.12, "goal", color=GOAL, fontsize=9, fontweight="bold")
    return axes


def space_tube(axes: Axes3D, problem: Problem, tubes: Tubes, reference: int) -> None:
    """One reference: cross-sections of its cells' tubes coloured by time, its start cells, and itself.

    What lies behind an obstacle for the viewer is drawn before it.
    """
    mine, index = tubes.cell_reference == reference, list(problem.dynamics.position)
    steps = shown_steps(problem, tubes.tube_lower[mine], tubes.tube_upper[mine])
    lower, upper = tubes.tube_lower[mine][:, :steps, index].min(0), tubes.tube_upper[mine][:, :steps, index].max(0)
    assert tubes.references is not None
    path = tubes.references[reference][:, index]
    shade = TIME(np.arange(steps) / max(1, tubes.tube_lower.shape[1] - 1))
    behind = _behind(axes, problem, 0.5 * (lower + upper))
    for part, zorder in ((behind, 1), (~behind, 4)):
        if part.any():
            faces = box_faces(lower[part], upper[part])
            edges = np.repeat(shade[part], 6, axis=0)
            axes.add_collection3d(
                Poly3DCollection(faces, facecolors=edges, edgecolors=edges, linewidths=0.3, alpha=0.22, zorder=zorder)
            )
    floor = np.full(len(path), float(problem.scene.workspace.lower[2]))
    axes.plot(path[:, 0], path[:, 1], floor, color=MUTED, linewidth=0.9, alpha=0.6, zorder=0.5)  # its shadow
    hidden = _behind(axes, problem, path)
    for part, zorder in ((hidden, 1.1), (~hidden, 5)):
        segments = [path[k : k + 2] for k in np.flatnonzero(part[:-1]) if k % 3 < 2]  # dashes
        axes.add_collection3d(
            Line3DCollection(segments, colors=REFERENCE, linewidths=1.3, zorder=zorder), autolim=False
        )
    cells = box_faces(tubes.cell_lower[mine][:, index], tubes.cell_upper[mine][:, index])
    axes.add_collection3d(Poly3DCollection(cells, facecolor=(0, 0, 0, 0), edgecolor=INK, linewidth=0.7, zorder=5))


def box_faces(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """The faces ``(6 count, 4, 3)`` of boxes ``(count, 3)``."""
    corners = np.where(_BITS, upper[:, None], lower[:, None])
    return corners[:, _FACES].reshape(-1, 4, 3)


def _sphere(axes: Axes3D, center: np.ndarray, radius: float) -> None:
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 73), np.linspace(0, np.pi, 37))
    unit = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], axis=-1)
    shade = 0.62 + 0.38 * np.clip(unit[:-1, :-1] @ _LIGHT, -0.6, 1)
    base = np.array([int(OBSTACLE[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    colours = np.concatenate([np.clip(shade[..., None] * base * 1.25, 0, 1), np.ones((*shade.shape, 1))], axis=-1)
    x, y, z = np.moveaxis(center + radius * unit, -1, 0)
    axes.plot_surface(x, y, z, rstride=1, cstride=1, facecolors=colours, shade=False, linewidth=0, zorder=2)


def _behind(axes: Axes3D, problem: Problem, points: np.ndarray) -> np.ndarray:
    """Which points are farther from the viewer than the middle of the obstacle nearest to them."""
    azim, elev = np.deg2rad(axes.azim), np.deg2rad(axes.elev)
    to_viewer = np.array([np.cos(elev) * np.cos(azim), np.cos(elev) * np.sin(azim), np.sin(elev)])
    middles: Sequence[np.ndarray] = [
        np.array(o.center) if isinstance(o, Ball) else 0.5 * (np.array(o.lower) + np.array(o.upper))
        for o in problem.scene.obstacles
    ]
    if not middles:
        return np.zeros(len(points), dtype=bool)
    offsets = points[:, None] - np.stack(middles)
    nearest = np.linalg.norm(offsets, axis=-1).argmin(-1)
    return offsets[np.arange(len(points)), nearest] @ to_viewer < 0
