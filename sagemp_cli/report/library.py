"""Figure: the library. Certified references with their tubes, and what was rejected and why."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from sagemp_cli.pipeline.problem import problem_of
from sagemp_cli.report.canvas import (
    DANGER,
    INK,
    MODES,
    MUTED,
    SAFE,
    UNKNOWN,
    blank_figure,
    draw_boxes,
    draw_paths,
    draw_scene,
    draw_start,
    headline,
    legend_above,
    plane_of,
    style_axes,
    subject,
)
from sagemp_cli.sets import Between
from sagemp_cli.storage import Artifact, Library


def draw_library(artifact: Artifact[Library]) -> Figure:
    """Tubes and references on the left, in a colour for each mode; the account of all samples on the right."""
    record, problem = artifact.record, problem_of(artifact.header.config)
    tubes, plane = record.tubes, plane_of(problem)
    assert tubes.references is not None
    count, horizon = len(tubes.verdict), tubes.tube_lower.shape[1] - 1
    figure = blank_figure(13, 5.4)
    grid = figure.add_gridspec(1, 2, width_ratios=(2.3, 1))

    scene = figure.add_subplot(grid[0])
    draw_scene(scene, problem)
    draw_start(scene, problem)
    early = np.array([r.startswith("reference") for r in record.rejected_reason], dtype=bool)
    for mask, colour in ((early, DANGER), (~early, UNKNOWN)):
        draw_paths(
            scene, record.rejected_references[mask][..., plane], colors=colour, linewidths=0.7, alpha=0.4, zorder=2.8
        )
    names = [*record.mode_names, *sorted(set(record.mode) - set(record.mode_names))]
    colour_of = {name: MODES[i % len(MODES)] for i, name in enumerate(names)}
    for r in range(count):
        mine, colour = tubes.cell_reference == r, colour_of[record.mode[r]]
        lower, upper = tubes.tube_lower[mine].min(0)[:, plane], tubes.tube_upper[mine].max(0)[:, plane]
        draw_boxes(scene, lower, upper, facecolors=colour, edgecolors="none", alpha=0.09, zorder=3)
        draw_boxes(scene, lower, upper, facecolors="none", edgecolors=colour, linewidths=0.4, alpha=0.55, zorder=3.1)
        scene.plot(*tubes.references[r][:, plane].T, color=colour, linewidth=1.6, zorder=7)
    proposed = dict(zip(record.mode_names, record.mode_drawn.tolist(), strict=True))
    total = max(1, sum(proposed.values()))
    handles = [
        Line2D([], [], color=colour_of[name], lw=2, label=_mode(name, record.mode.count(name), proposed, total))
        for name in names
    ]
    if early.any():
        handles.append(Line2D([], [], color=DANGER, lw=2, label="reference rejected"))
    if (~early).any():
        handles.append(Line2D([], [], color=UNKNOWN, lw=2, label="tube rejected"))
    legend_above(scene, handles)

    axes = figure.add_subplot(grid[1])
    rows = [("certified", count, SAFE)]
    rows += [
        (name, number, DANGER if name.startswith("reference") else UNKNOWN)
        for name, number in zip(record.reason_names, record.reason_counts.tolist(), strict=True)
    ]
    rows.append(("not needed", record.sampled - sum(number for _, number, _ in rows), MUTED))
    kinds, values, colours = zip(*(row for row in rows if row[1]), strict=True)
    style_axes(axes, xlabel="references sampled")
    axes.barh(range(len(kinds)), values, color=colours, height=0.62)
    axes.set_yticks(range(len(kinds)), kinds, fontsize=9, color=INK)
    axes.invert_yaxis()
    axes.grid(axis="y", visible=False)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    for i, value in enumerate(values):
        axes.annotate(str(value), (value, i), (4, 0), textcoords="offset points", va="center", fontsize=9, color=MUTED)
    axes.set_xlim(0, 1.15 * max(values))
    headline(
        figure,
        f"Library of {count} certified reference{'s' * (count > 1)}"
        + (f" ({record.wanted} wanted)" if count < record.wanted else ""),
        f"{subject(artifact.header)}: {record.sampled} references sampled, "
        f"{len(tubes.cell_reference) // count} cells each, K = {horizon}, "
        f"{tubes.propagator} in {tubes.seconds.sum():.2g} s; "
        f"certified clearance at least {tubes.clearance.min():.2f} m {Between(tubes.between).words}",
        colour=SAFE if count >= record.wanted else INK,
    )
    return figure


def _mode(name: str, held: int, proposed: dict[str, int], total: int) -> str:
    """What the legend says of a mode."""
    if not name:
        return "certified, with tube"
    return f"{name}: {held} certified, {proposed.get(name, 0) / total:.0%} of the planner's"
