"""Figure: what was proved of a stranger's loop. Every state over time, and a map if the scene is a plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Rectangle

from sagemp_cli.report.canvas import (
    DANGER,
    GOAL,
    INK,
    MODES,
    MUTED,
    OBSTACLE,
    UNKNOWN,
    VERDICT_COLOURS,
    blank_figure,
    broken_at,
    draw_boxes,
    headline,
    legend_above,
    style_axes,
    tube_boxes,
    unit_text,
)
from sagemp_cli.scenes.scene import Ball, Scene
from sagemp_cli.sets.between import Between, moment
from sagemp_cli.storage import Counterexample, Tubes

_SAYS = {
    "VERIFIED": "Certified",
    "FALSIFIED": "Falsified: a replayed counterexample breaks the claim",
    "UNKNOWN": "Unknown: the tube does not prove it, and no counterexample was found",
}
_WIDE = 20.0
"""A tube is drawn up to the step where it is so many times as wide as ever before, and as its path is long."""


@dataclass(frozen=True)
class LoopSetting:
    """What a loop's numbers mean.

    Attributes:
        name: of the loop.
        state_names, state_units: n words each.
        position: entries of the state that the scene is about; empty if there is none.
        scene: infinite where nothing is asked for.
        dt: seconds between samples; None: steps are counted.
    """

    name: str
    state_names: Sequence[str]
    state_units: Sequence[str]
    position: Sequence[int]
    scene: Scene
    dt: float | None = None

    def label(self, state: int) -> str:
        """Axis label of a state."""
        unit = self.state_units[state]
        return f"{self.state_names[state]} ({unit_text(unit)})" if unit else self.state_names[state]


def draw_loop(tubes: Tubes, setting: LoopSetting, verdict: str, examples: Sequence[Counterexample] = ()) -> Figure:
    """The tube of every cell, what the scene asks for, and a counterexample if there is one."""
    steps, n = tubes.tube_lower.shape[1] - 1, tubes.tube_lower.shape[2]
    flat = len(setting.position) == 2
    columns = 1 if n <= 5 else 2
    rows = -(-n // columns)
    figure = blank_figure((7 if flat else 0) + 7.5 * columns, max(4.2, 1.9 * rows))
    grid = figure.add_gridspec(rows, columns + flat, width_ratios=([1.0] * flat) + [1.0] * columns)
    shown = _shown(tubes)
    if flat:
        axes = figure.add_subplot(grid[:, 0])
        _map(axes, tubes, setting, shown, examples)
    times = np.arange(steps + 1) * (setting.dt or 1.0)
    panels: list[Axes] = []
    for state in range(n):
        place = grid[state % rows, flat + state // rows]
        axes = figure.add_subplot(place, sharex=panels[0] if panels else None)
        panels.append(axes)
        last = state % rows == rows - 1 or state == n - 1
        style_axes(axes, ylabel=setting.label(state), xlabel=("time (s)" if setting.dt else "step") if last else "")
        axes.tick_params(labelbottom=last)
        _band(axes, times, tubes, state, shown)
        for example in examples:
            axes.plot(times, example.states[:, state], color=DANGER, linewidth=1.3, zorder=8)
        _asked(axes, times, setting, state)
    handles: list[Any] = [Patch(facecolor=MODES[0], alpha=0.35, label=f"tube of each cell ({len(tubes.cell_lower)})")]
    if setting.scene.goal.has_faces:
        handles.append(Line2D([], [], color=GOAL, lw=4, label="goal"))
    if examples:
        handles.append(Line2D([], [], color=DANGER, lw=1.3, label="counterexample"))
    legend_above(panels[0], handles)
    panels[0].set_xlim(times[0], times[-1])
    proof = "rounding included" if tubes.rigorous else "sound in exact arithmetic"
    duration = f" ({steps * setting.dt:g} s)" if setting.dt else ""
    cells = f"{len(tubes.cell_lower)} cell{'s' * (len(tubes.cell_lower) > 1)}"
    headline(
        figure,
        _SAYS[verdict] + (f": {_aim(setting)}" if verdict == "VERIFIED" else ""),
        f"{setting.name}: {_deciding(tubes, setting.dt)}; {cells}, "
        f"K = {steps}{duration}, {tubes.propagator} in {tubes.seconds.sum():.2g} s, {proof}{_when(tubes, setting)}",
        colour=VERDICT_COLOURS.get(verdict, INK),
    )
    return figure


def _aim(setting: LoopSetting) -> str:
    """What a proof says, in words."""
    parts = []
    if setting.scene.workspace.has_faces:
        parts.append("stays in the workspace")
    if setting.scene.obstacles:
        parts.append("stays clear")
    if setting.scene.goal.has_faces:
        parts.append("ends in the goal")
    return f"every start in X$_I$ {' and '.join(parts)}" if parts else "every rollout stays in this tube"


def _deciding(tubes: Tubes, dt: float | None) -> str:
    if tubes.verdict[0] == "SAFE":
        return "SAFE"
    when = moment(int(tubes.step[0]), float(tubes.fraction[0]), dt)
    return f"{tubes.verdict[0]} at {when} ({tubes.constraint[0]})"


def _when(tubes: Tubes, setting: LoopSetting) -> str:
    """When the scene is kept clear of, if it asks for that."""
    asked = setting.scene.workspace.has_faces or setting.scene.obstacles
    return f"; clear {Between(tubes.between).words}" if asked else ""


def _shown(tubes: Tubes) -> int:
    """Steps that can be drawn: up to where the tube overflows or outgrows everything before it."""
    low, high = tubes.tube_lower.min(0), tubes.tube_upper.max(0)
    finite = np.isfinite(low).all(-1) & np.isfinite(high).all(-1)
    count = len(finite) if finite.all() else int(finite.argmin())
    low, high = low[:count], high[:count]
    with np.errstate(over="ignore"):
        width, middle = high - low, 0.5 * low + 0.5 * high
        path = np.maximum.accumulate(middle, 0) - np.minimum.accumulate(middle, 0)
        usual = np.maximum(np.maximum.accumulate(width, 0)[:-1], path[1:])
        grown = (width[1:] > _WIDE * np.maximum(usual, 1e-6 * (1 + abs(middle[1:])))).any(-1)
    return int(grown.argmax()) + 1 if grown.any() else count


def _band(axes: Axes, times: np.ndarray, tubes: Tubes, state: int, shown: int) -> None:
    lower, upper = tubes.tube_lower[:, :shown, state], tubes.tube_upper[:, :shown, state]
    across = np.concatenate([times[:shown], times[:shown][::-1]])
    around = np.concatenate([lower, upper[:, ::-1]], axis=1)
    outlines = np.stack([np.broadcast_to(across, around.shape), around], axis=-1)
    alpha = 0.35 / np.sqrt(max(1, len(lower) / 2))
    axes.add_collection(PolyCollection(list(outlines), color=MODES[0], alpha=alpha, linewidth=0))
    axes.plot(times[:shown], lower.min(0), color=MODES[0], linewidth=0.9)
    axes.plot(times[:shown], upper.max(0), color=MODES[0], linewidth=0.9)
    if shown < len(times):
        axes.axvline(times[shown], color=UNKNOWN, linewidth=1.1, linestyle=(0, (2, 2)))


def _asked(axes: Axes, times: np.ndarray, setting: LoopSetting, state: int) -> None:
    """The goal as a bracket at the end; the workspace and, of a line, obstacles over all times."""
    bottom, top = axes.get_ylim()
    low, high = float(setting.scene.goal.lower[state]), float(setting.scene.goal.upper[state])
    if np.isfinite(low) or np.isfinite(high):
        ends = [max(low, bottom), min(high, top)] if low <= top and high >= bottom else [low, high]
        axes.plot([times[-1]] * 2, ends, color=GOAL, linewidth=4, solid_capstyle="butt", zorder=6, clip_on=False)
    if state not in setting.position:
        return
    i = list(setting.position).index(state)
    for face in (float(setting.scene.workspace.lower[i]), float(setting.scene.workspace.upper[i])):
        if np.isfinite(face):
            axes.axhline(face, color=INK, linewidth=1.0, linestyle=(0, (4, 3)))
    if len(setting.position) == 1:
        for obstacle in setting.scene.obstacles:
            ball = isinstance(obstacle, Ball)
            first = obstacle.center[0] - obstacle.radius if ball else obstacle.lower[0]
            axes.axhspan(first, first + 2 * obstacle.radius if ball else obstacle.upper[0], color=OBSTACLE, alpha=0.6)


def _map(axes: Axes, tubes: Tubes, setting: LoopSetting, shown: int, examples: Sequence[Counterexample]) -> None:
    plane = list(setting.position)
    style_axes(axes, xlabel=setting.label(plane[0]), ylabel=setting.label(plane[1]))
    lower, upper = tubes.tube_lower[:, :shown, plane], tubes.tube_upper[:, :shown, plane]
    tube_boxes(axes, lower, upper, of=tubes.tube_lower.shape[1])
    draw_boxes(
        axes, tubes.cell_lower[:, plane], tubes.cell_upper[:, plane], facecolors="none", edgecolors=INK, zorder=5
    )
    for obstacle in setting.scene.obstacles:
        if isinstance(obstacle, Ball):
            place = (obstacle.center[0], obstacle.center[1])
            axes.add_patch(Circle(place, obstacle.radius, facecolor=OBSTACLE, zorder=2))
        else:
            (a, b), (c, d) = obstacle.lower, obstacle.upper
            axes.add_patch(Rectangle((a, b), c - a, d - b, facecolor=OBSTACLE, zorder=2))
            place = (0.5 * (a + c), 0.5 * (b + d))
        axes.annotate(obstacle.name, place, ha="center", va="center", fontsize=7.5, color=MUTED, clip_on=True)
    ends = [v for box in (setting.scene.workspace, setting.scene.goal) for v in (box.lower, box.upper)]
    corners = [v.numpy() if len(v) == 2 else v[plane].numpy() for v in ends]
    for low, high, colour in ((*corners[:2], INK), (*corners[2:], GOAL)):
        if np.isfinite(low).all() and np.isfinite(high).all():
            axes.add_patch(Rectangle(tuple(low), *(high - low), fill=False, edgecolor=colour, linewidth=1.4, zorder=7))
    for example in examples:
        path = example.states[:, plane]
        axes.plot(*path.T, color=DANGER, linewidth=1.6, zorder=8)
        axes.scatter(*broken_at(path, example), s=46, marker="X", color=DANGER, zorder=9)
    points = [p for p in (lower.reshape(-1, 2).min(0), upper.reshape(-1, 2).max(0), *corners) if np.isfinite(p).all()]
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    pad = 0.03 * np.maximum(high - low, 1e-9)
    axes.set_xlim(low[0] - pad[0], high[0] + pad[0])
    axes.set_ylim(low[1] - pad[1], high[1] + pad[1])
