"""Figure: the same references executed open loop, tracked, and certified, side by side."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sagemp_cli.pipeline.problem import problem_of
from sagemp_cli.report.canvas import (
    DANGER,
    INK,
    MODES,
    MUTED,
    REFERENCE,
    SAFE,
    blank_figure,
    draw_boxes,
    draw_paths,
    draw_scene,
    draw_start,
    headline,
    plane_of,
    subject,
)
from sagemp_cli.report.safety_table import CERTIFIED, SafetyRow, certified, percentage, safety_rows
from sagemp_cli.storage import Artifact, SafetyRates, Trials

CALM = MODES[0]
"""Colour of rollouts that were safe; green is for what is proved."""


def draw_safety(artifact: Artifact[SafetyRates]) -> Figure:
    """Rollouts of each reference open loop and closed loop; the certified ones with their tubes.

    Of each reference and kind of disturbance the rollout of the least clearance is drawn. Each panel says which share
    of the references is safe in it (all their rollouts are), and the paper's where there is one.
    """
    record, problem = artifact.record, problem_of(artifact.header.config)
    plane, proved = plane_of(problem), certified(record)
    rows = open_row, closed_row, proof_row = safety_rows(artifact)
    figure = blank_figure(15, 7.0)
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    for axes, row in zip(panels, rows, strict=True):
        draw_scene(axes, problem)
        draw_start(axes, problem)
        _title(axes, row)
    for axes in panels[1:]:
        axes.set_ylabel("")
    _draw_trials(panels[0], record.open_loop, plane)
    _draw_trials(panels[1], record.closed_loop, plane)
    tubes = record.tube_lower[proved][..., plane], record.tube_upper[proved][..., plane]
    for lower, upper in zip(*tubes, strict=True):
        draw_boxes(panels[2], lower, upper, facecolors=SAFE, edgecolors="none", alpha=0.02, zorder=3)
        draw_boxes(panels[2], lower, upper, facecolors="none", edgecolors=SAFE, linewidths=0.25, alpha=0.12, zorder=3.1)
    references = record.references[..., plane]
    draw_paths(panels[2], references[proved], colors=REFERENCE, linewidths=0.7, alpha=0.6, zorder=7)
    draw_paths(panels[2], references[~proved], colors=MUTED, linewidths=0.8, linestyles=(0, (3, 2)), zorder=2.8)
    handles = (
        Line2D([], [], color=CALM, lw=2, label="rollout, safe"),
        Line2D([], [], color=DANGER, lw=2, label="rollout, unsafe"),
        Line2D([], [], color=REFERENCE, lw=2, label="plan, certified"),
        Line2D([], [], color=SAFE, lw=2, label="its tube"),
        Line2D([], [], color=MUTED, lw=2, ls=(0, (3, 2)), label="plan, not certified"),
    )
    figure.legend(handles=handles, loc="outside lower center", ncols=5, frameon=False, fontsize=9.5, labelcolor=INK)
    headline(
        figure,
        f"Safe from all of X$_I$: {open_row.safe} of {open_row.sampled} plans open loop, {closed_row.safe} tracked, "
        f"{proof_row.safe} proved",
        f"{subject(artifact.header)}: {open_row.rollouts} rollouts of each plan under each kind of disturbance w, "
        f"those of least clearance shown; a plan is safe if all are. {record.propagator} proved {proof_row.safe} in "
        f"{record.seconds.sum():.2g} s; safe is: over the whole of every step",
    )
    return figure


def _draw_trials(axes: Axes, trials: Trials, plane: list[int]) -> None:
    """Rollouts of least clearance, the unsafe ones in front; one that overflowed ends there."""
    good = trials.clearance.min(-1) > 0
    paths = np.ma.masked_invalid(trials.nearest[..., plane])
    alpha = float(np.clip(2 / np.sqrt(len(paths)), 0.15, 0.6))
    for mask, colour, zorder in ((good, CALM, 3), (~good, DANGER, 4)):
        draw_paths(axes, paths[mask], colors=colour, linewidths=0.6, alpha=alpha, zorder=zorder)


def _title(axes: Axes, row: SafetyRow) -> None:
    """The way and its share, large; below it what that is of, the paper's, and the rollouts' shares."""
    colour = SAFE if row.way == CERTIFIED else CALM if row.safe == row.sampled else DANGER
    text = f"{row.way.capitalize()}: {percentage(row.safe / row.sampled)}"
    axes.set_title(text, fontsize=14, fontweight="bold", color=colour, loc="left", pad=34)
    paper = "" if row.paper is None else f"; paper: {percentage(row.paper)} of {row.paper_sampled}"
    shares = ", ".join(f"w {kind}: {percentage(share)}" for kind, share in row.rollouts_safe.items())
    below = f"{row.safe} of {row.sampled} plans{paper}\nsafe rollouts, {shares}"
    note = axes.annotate(below, (0, 1), (0, 5), "axes fraction", "offset points", fontsize=9, color=MUTED)
    note.set_in_layout(False)  # the title's padding has room for it
