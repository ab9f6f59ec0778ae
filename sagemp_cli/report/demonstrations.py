"""Figure: the expert's demonstrations, by the sides on which they pass the obstacles."""

from __future__ import annotations

from collections import Counter

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sagemp_cli.pipeline.problem import problem_of
from sagemp_cli.report.canvas import (
    MODES,
    MUTED,
    blank_figure,
    draw_paths,
    draw_scene,
    headline,
    legend_above,
    plane_of,
    style_axes,
    unit_text,
)
from sagemp_cli.storage import Artifact, Demonstrations


def draw_demonstrations(artifact: Artifact[Demonstrations]) -> Figure:
    """Positions to scale on the left, controls over time with their limits on the right."""
    record, problem = artifact.record, problem_of(artifact.header.config)
    dynamics = problem.dynamics
    count, horizon = record.controls.shape[:2]
    groups = [side for side, _ in Counter(record.side).most_common()]
    colour = {side: MODES[i % len(MODES)] for i, side in enumerate(groups)}
    sides = np.array(record.side)
    alpha = float(np.clip(12 / np.sqrt(count) / 4, 0.12, 0.8))

    figure = blank_figure(13, max(5.2, 1.75 * dynamics.control_dim))
    grid = figure.add_gridspec(dynamics.control_dim, 2, width_ratios=(2.3, 1))
    scene = figure.add_subplot(grid[:, 0])
    draw_scene(scene, problem)
    plane = plane_of(problem)
    for side in groups:
        draw_paths(
            scene,
            record.states[sides == side][..., plane],
            colors=colour[side],
            linewidths=0.8,
            alpha=alpha,
        )
    starts = record.states[:, 0, plane]
    scene.scatter(starts[:, 0], starts[:, 1], s=5, color=MUTED, linewidths=0, zorder=4)
    handles = [Line2D([], [], color=colour[s], lw=2, label=f"{s or 'free'}: {int((sides == s).sum())}") for s in groups]
    legend_above(scene, handles)

    times = dynamics.dt * np.arange(horizon)
    for i, name in enumerate(dynamics.control_names):
        axes = figure.add_subplot(grid[i, 1])
        style_axes(axes, ylabel=f"{name} ({unit_text(dynamics.control_units[i])})")
        for side in groups:
            curves = record.controls[sides == side][..., i]
            lines = np.stack([np.broadcast_to(times, curves.shape), curves], axis=-1)
            draw_paths(axes, lines, colors=colour[side], linewidths=0.6, alpha=alpha)
        for limit in (float(dynamics.control_lower[i]), float(dynamics.control_upper[i])):
            if np.isfinite(limit):
                axes.axhline(limit, color=MUTED, linewidth=1, linestyle=(0, (4, 3)))
        axes.autoscale_view()
        axes.set_xlim(0, dynamics.dt * horizon)
    figure.axes[-1].set_xlabel("time (s)", fontsize=9.5)
    headline(
        figure,
        f"{count} demonstrations",
        f"{artifact.header.experiment}, K = {horizon}, dt = {dynamics.dt:g} s; "
        f"{len(record.failed)} problems unsolved; obstacles passed on the left (L) or right (R) in {len(groups)} "
        f"combination{'s' * (len(groups) > 1)}; smallest clearance {record.clearance.min():.2f} m, "
        f"limits exceeded by {max(record.control_violation.max(), record.state_violation.max()):.2g}",
    )
    return figure
