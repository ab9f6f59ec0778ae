"""Figure: executions of Algorithm 3 against the certified tubes."""

from __future__ import annotations

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from sagemp_cli.pipeline.problem import problem_of
from sagemp_cli.report.canvas import (
    DANGER,
    MODES,
    MUTED,
    SAFE,
    blank_figure,
    draw_boxes,
    draw_paths,
    draw_scene,
    draw_start,
    goal_at_end,
    headline,
    legend_above,
    plane_of,
    state_label,
    style_axes,
    subject,
)
from sagemp_cli.sets import Between
from sagemp_cli.storage import Artifact, Library, Rollouts

DRAWN = 600
"""Rollouts drawn at most, evenly spaced; those that left their tube are always drawn."""

NAMED = 3
"""References that the legend names one by one; more are told apart by colour only."""


def draw_rollouts(artifact: Artifact[Rollouts], library: Artifact[Library]) -> Figure:
    """Rollouts to scale over the tubes of the references that were tracked; every state over time beside them."""
    record, problem = artifact.record, problem_of(artifact.header.config)
    dynamics, tubes, plane = problem.dynamics, library.record.tubes, plane_of(problem)
    total, horizon = len(record.states), record.states.shape[1] - 1
    chosen = record.chosen[record.query]
    some = np.unique(np.linspace(0, total - 1, min(DRAWN, total)).astype(int))
    alpha = float(np.clip(6 / np.sqrt(len(some)) / 3, 0.08, 0.6))

    columns = 1 if dynamics.state_dim <= 8 else 2
    rows = -(-dynamics.state_dim // columns)
    figure = blank_figure(12 + 2 * columns, max(5.4, 1.35 * rows))
    grid = figure.add_gridspec(rows, 1 + columns, width_ratios=(2.05, *[1] * columns))
    scene = figure.add_subplot(grid[:, 0])
    draw_scene(scene, problem)
    draw_start(scene, problem)
    panels, times = [], dynamics.dt * np.arange(horizon + 1)
    for i in range(dynamics.state_dim):
        axes = figure.add_subplot(grid[i % rows, 1 + i // rows], sharex=panels[0] if panels else None)
        last = i % rows == rows - 1 or i == dynamics.state_dim - 1
        style_axes(axes, ylabel=state_label(problem, i), xlabel="time (s)" if last else "")
        axes.tick_params(labelbottom=last)
        panels.append(axes)
    for r in np.unique(chosen):
        mine, colour = tubes.cell_reference == r, MODES[r % len(MODES)]
        lower, upper = tubes.tube_lower[mine].min(0), tubes.tube_upper[mine].max(0)
        states = record.states[some[chosen[some] == r]]
        low, high = lower[:, plane], upper[:, plane]
        draw_boxes(scene, low, high, facecolors=colour, edgecolors="none", alpha=0.07, zorder=2.7)
        draw_paths(scene, states[..., plane], colors=colour, linewidths=0.5, alpha=alpha, zorder=4)
        for i, axes in enumerate(panels):
            axes.fill_between(times, lower[:, i], upper[:, i], color=colour, alpha=0.12, linewidth=0)
            curves = states[..., i]
            lines = np.stack([np.broadcast_to(times, curves.shape), curves], axis=-1)
            draw_paths(axes, lines, colors=colour, linewidths=0.4, alpha=alpha)
    escaped = record.states[~record.in_tube]
    draw_paths(scene, escaped[..., plane], colors=DANGER, linewidths=1.2, zorder=8)
    proposals = record.sampled_references[..., plane]
    draw_paths(scene, proposals, colors=MUTED, linewidths=0.6, linestyles=(0, (4, 3)), zorder=3.5)
    for i, axes in enumerate(panels):
        axes.autoscale_view()
        axes.set_xlim(0, times[-1])
        goal_at_end(axes, problem, i, times[-1])
    figure.align_ylabels(panels)
    tracked = np.unique(chosen)
    handles: list[Artist]
    if len(tracked) <= NAMED:
        handles = [Line2D([], [], color=MODES[i % len(MODES)], lw=2, label=f"tracks {i}") for i in tracked]
    else:
        handles = [Line2D([], [], color=MODES[0], lw=2, label="rollout, coloured by reference")]
    handles.append(Patch(facecolor=MUTED, alpha=0.25, label="tube"))
    handles.append(Line2D([], [], color=MUTED, lw=1, ls=(0, (4, 3)), label="planner's proposal"))
    legend_above(scene, handles)

    inside, safe = int(record.in_tube.sum()), int(record.safe.sum())
    text = "All" if inside == total else f"Only {inside} of"
    headline(
        figure,
        f"{text} {total} rollouts stayed in their tube",
        f"{subject(artifact.header)}: {len(record.chosen)} starts measured in X$_I$, closest of "
        f"{len(tubes.verdict)} certified references tracked (mean E = {record.reference_error.mean():.3g}); "
        "random and worst-case disturbances; "
        f"{safe} of {total} kept clear {Between(tubes.between).words} and reached the goal",
        colour=SAFE if inside == total else DANGER,
    )
    return figure
