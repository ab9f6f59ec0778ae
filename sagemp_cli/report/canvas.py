"""What all figures share: one palette, one type size, scenes drawn to scale, states over time."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Circle, Rectangle
from matplotlib.patheffects import withStroke

from sagemp_cli.pipeline.models import stand_in
from sagemp_cli.problem import Problem
from sagemp_cli.scenes import Ball
from sagemp_cli.storage import Counterexample, Header

INK = "#1f2a37"
MUTED = "#6b7785"
HAIRLINE = "#dfe4ea"
OBSTACLE = "#566273"
GOAL = "#2b9348"
REFERENCE = "#111827"
SAFE = "#1d7f45"
UNKNOWN = "#b86e00"
DANGER = "#c81e3a"
MODES = ("#2a6fbb", "#d9730d", "#7b4fb5", "#00838f", "#a8415b", "#5d7c15")
"""Colours of distinct things without order: sides, references, library entries."""
TIME = LinearSegmentedColormap.from_list("time", ["#8fd3e8", "#3f8fc6", "#3a55a4", "#5a2a82", "#2d0f4f"])
"""Light to dark with time."""
_PLATE = {"boxstyle": "round,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.75}
"""What keeps a name readable on top of tubes and paths."""
VERDICT_COLOURS = {
    "SAFE": SAFE,
    "VERIFIED": SAFE,
    "UNSAFE": DANGER,
    "FALSIFIED": DANGER,
    "MAY_COLLIDE": UNKNOWN,
    "MISSES_GOAL": UNKNOWN,
    "UNBOUNDED": UNKNOWN,
    "UNKNOWN": UNKNOWN,
}


def plane_of(problem: Problem) -> list[int]:
    """The two states that a map of the workspace shows: the first two of the position."""
    return list(problem.dynamics.position[:2])


def state_label(problem: Problem, state: int) -> str:
    """Axis label of a state, with its unit."""
    return f"{problem.dynamics.state_names[state]} ({unit_text(problem.dynamics.state_units[state])})"


def unit_text(unit: str, *, per_second: bool = False) -> str:
    """A unit as it is set in a figure, ``m/s^2`` as m/s²; ``per_second`` that of the derivative."""
    if per_second:
        unit = f"{unit}^2" if unit.endswith("/s") else f"{unit}/s"
    return unit.replace("^2", "²")


def blank_figure(width: float, height: float) -> Figure:
    """A white figure of the given size in inches."""
    return Figure(figsize=(width, height), dpi=150, facecolor="white", layout="constrained")


def subject(header: Header) -> str:
    """The experiment's name, and what stands in for the planner if something does."""
    instead = stand_in(header.config)
    return f"{header.experiment} [plans of a {instead}]" if instead else header.experiment


def broken_at(path: np.ndarray, example: Counterexample) -> np.ndarray:
    """Where on its path ``(K+1, d)`` a counterexample breaks the claim."""
    after = path[min(example.step + 1, len(path) - 1)]
    return path[example.step] + example.fraction * (after - path[example.step])


def headline(figure: Figure, text: str, subtitle: str, *, colour: str = INK) -> None:
    """What the figure says, and under which conditions: at the top left, the conditions wrapped to its width."""
    lines = textwrap.wrap(subtitle, int(12.6 * figure.get_figwidth()))
    height = figure.get_figheight()
    layout = figure.get_layout_engine()
    assert isinstance(layout, ConstrainedLayoutEngine)
    layout.set(rect=(0.004, 0.004, 0.988, 0.996 - (0.44 + 0.18 * len(lines)) / height))
    top = 1 - 0.12 / height
    figure.text(0.012, top, text, ha="left", va="top", fontsize=14, fontweight="bold", color=colour)
    below = top - 0.27 / height
    figure.text(0.012, below, "\n".join(lines), ha="left", va="top", fontsize=9.5, color=MUTED, linespacing=1.3)


def style_axes(axes: Axes, *, xlabel: str = "", ylabel: str = "", title: str = "") -> None:
    """Quiet axes: hairline grid below the data, no box."""
    axes.set_axisbelow(True)
    axes.grid(color=HAIRLINE, linewidth=0.6)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(MUTED)
    axes.tick_params(colors=MUTED, labelsize=8.5, length=3)
    axes.set_xlabel(xlabel, fontsize=9.5, color=INK)
    axes.set_ylabel(ylabel, fontsize=9.5, color=INK)
    if title:
        axes.set_title(title, fontsize=10, color=INK, loc="left")


def draw_scene(axes: Axes, problem: Problem, *, names: bool = True) -> None:
    """Workspace, obstacles, landmarks (dashed) and goal to scale; a three-dimensional scene is seen from above."""
    if len(problem.dynamics.position) == 3:
        axes.annotate("seen from above", (0, 1), (2, 4), "axes fraction", "offset points", fontsize=8.5, color=MUTED)
    scene, (i, j) = problem.scene, plane_of(problem)
    low, high = scene.workspace.lower.tolist(), scene.workspace.upper.tolist()
    style_axes(axes, xlabel=state_label(problem, i), ylabel=state_label(problem, j))
    axes.set_aspect("equal")
    pad = 0.015 * max(high[0] - low[0], high[1] - low[1])
    axes.set_xlim(low[0] - pad, high[0] + pad)
    axes.set_ylim(low[1] - pad, high[1] + pad)
    axes.add_patch(_box(low, high, fill=False, edgecolor=INK, linewidth=1.4, zorder=1))
    for obstacle in scene.obstacles:
        if isinstance(obstacle, Ball):
            center = _point(obstacle.center)
            axes.add_patch(Circle(center, obstacle.radius, facecolor=OBSTACLE, edgecolor="none", zorder=2))
        else:
            center = _point([0.5 * (a + b) for a, b in zip(obstacle.lower, obstacle.upper, strict=True)])
            axes.add_patch(_box(obstacle.lower, obstacle.upper, facecolor=OBSTACLE, edgecolor="none", zorder=2))
        if names:
            axes.annotate(obstacle.name, center, ha="center", va="center", fontsize=7.5, color="white", zorder=2.5)
    for landmark in scene.landmarks:
        center = _point(landmark.center)
        outline = {"fill": False, "edgecolor": MUTED, "linewidth": 1.1, "linestyle": (0, (2, 2))}
        axes.add_patch(Circle(center, landmark.radius, zorder=2, **outline))
        if names:
            at = (center[0], center[1] - landmark.radius)
            _name(axes, landmark.name, at, (0, -3), ha="center", va="top", fontsize=7.5, color=MUTED)
    goal_low = np.maximum([scene.goal.lower[i], scene.goal.lower[j]], low[:2])
    goal_high = np.minimum([scene.goal.upper[i], scene.goal.upper[j]], high[:2])
    axes.add_patch(_box(goal_low, goal_high, facecolor=GOAL, alpha=0.16, edgecolor="none", zorder=1.5))
    halo = [withStroke(linewidth=3.2, foreground="white")]
    axes.add_patch(_box(goal_low, goal_high, fill=False, edgecolor=GOAL, linewidth=1.6, zorder=7.5, path_effects=halo))
    if names:
        at = (0.5 * (goal_low[0] + goal_high[0]), goal_high[1])
        _name(axes, "goal", at, (0, 4), ha="center", fontsize=8.5, color=GOAL, fontweight="bold")


def draw_start(axes: Axes, problem: Problem) -> None:
    """The outline of X_I."""
    low, high = problem.start.lower[plane_of(problem)].tolist(), problem.start.upper[plane_of(problem)].tolist()
    axes.add_patch(_box(low, high, fill=False, edgecolor=INK, linewidth=1.1, linestyle=(0, (3, 2)), zorder=7.5))
    _name(axes, "X$_I$", (low[0], high[1]), (2, 5), fontsize=9, color=INK)


def draw_paths(axes: Axes, paths: np.ndarray, **options: Any) -> None:
    """Many paths ``(count, K+1, 2)`` as one collection."""
    axes.add_collection(LineCollection(list(np.asarray(paths)), **({"capstyle": "round", "zorder": 3} | options)))


def draw_boxes(axes: Axes, lower: np.ndarray, upper: np.ndarray, **options: Any) -> None:
    """Boxes ``(count, 2)`` as one collection; infinite ones are left out."""
    finite = np.asarray(np.isfinite(lower).all(-1) & np.isfinite(upper).all(-1))
    (left, bottom), (right, top) = np.asarray(lower)[finite].T, np.asarray(upper)[finite].T
    corners = np.stack([left, bottom, right, bottom, right, top, left, top], axis=-1).reshape(-1, 4, 2)
    options = {k: v[finite] if isinstance(v, np.ndarray) and len(v) == len(finite) else v for k, v in options.items()}
    axes.add_collection(PolyCollection(list(corners), **options), autolim=False)


def shown_steps(problem: Problem, lower: np.ndarray, upper: np.ndarray) -> int:
    """How many steps of tubes ``(cells, K+1, n)`` can be drawn: up to the first that is wider than the workspace."""
    size = (problem.scene.workspace.upper - problem.scene.workspace.lower).numpy()
    position = list(problem.dynamics.position)
    with np.errstate(invalid="ignore", over="ignore"):
        fits = np.asarray((upper[..., position] - lower[..., position] <= size).all(-1).all(0))
    return len(fits) if fits.all() else int(fits.argmin())


def tube_boxes(axes: Axes, lower: np.ndarray, upper: np.ndarray, *, alpha: float = 0.3, of: int | None = None) -> None:
    """Cross-sections ``(cells, steps, 2)`` over the plane, coloured by time, cell after cell; ``of`` K + 1."""
    cells, steps = lower.shape[:2]
    shade = np.tile(TIME(np.arange(steps) / max(1, (of or steps) - 1)), (cells, 1))
    low, high = lower.reshape(-1, 2), upper.reshape(-1, 2)
    draw_boxes(axes, low, high, facecolors=shade, edgecolors="none", alpha=alpha, zorder=3)
    draw_boxes(axes, low, high, facecolors="none", edgecolors=shade, linewidths=0.35, alpha=0.75, zorder=3.1)


def time_bar(figure: Figure, axes: Axes | Sequence[Axes], seconds: float) -> None:
    """The colour scale of :data:`TIME`."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    bar = figure.colorbar(
        ScalarMappable(Normalize(0, seconds), TIME),
        ax=axes,
        orientation="horizontal",
        fraction=0.035,
        pad=0.02,
        shrink=0.7,
        aspect=45,
    )
    bar.outline.set_visible(False)
    bar.ax.tick_params(colors=MUTED, labelsize=8.5, length=3)
    bar.set_label("tube: where the robot can be at time (s)", fontsize=9.5, color=INK)


def goal_at_end(axes: Axes, problem: Problem, state: int, end: float) -> None:
    """The goal's faces in one state as a bracket at the end of the time axis."""
    low, high = float(problem.scene.goal.lower[state]), float(problem.scene.goal.upper[state])
    if np.isfinite(low) or np.isfinite(high):
        bottom, top = axes.get_ylim()
        low, high = max(low, bottom), min(high, top)
        axes.plot([end, end], [low, high], color=GOAL, linewidth=4, solid_capstyle="butt", zorder=6, clip_on=False)


def legend(axes: Axes, **options: Any) -> None:
    """A legend without a box around it."""
    axes.legend(**({"frameon": False, "fontsize": 8.5, "labelcolor": INK, "handlelength": 1.6} | options))


def legend_above(axes: Axes, handles: Sequence[Any]) -> None:
    """A one-line legend above the axes at the right, where it hides nothing."""
    legend(
        axes,
        handles=handles,
        loc="lower right",
        bbox_to_anchor=(1.0, 0.995),
        ncols=len(handles),
        borderaxespad=0.1,
        columnspacing=1.4,
    )


def _point(place: Sequence[float]) -> tuple[float, float]:
    """The first two coordinates."""
    return float(place[0]), float(place[1])


def _name(axes: Axes, text: str, at: tuple[float, float], offset: tuple[float, float], **options: Any) -> None:
    """The name of a thing, on top of everything; ``offset`` in points."""
    axes.annotate(text, at, offset, textcoords="offset points", zorder=9, bbox=_PLATE, **options)


def _box(lower: Sequence[float] | np.ndarray, upper: Sequence[float] | np.ndarray, **options: Any) -> Rectangle:
    return Rectangle(
        (float(lower[0]), float(lower[1])), float(upper[0] - lower[0]), float(upper[1] - lower[1]), **options
    )
