"""Figure: the course of a training run and the model card."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from sagemp_cli.report.canvas import INK, MODES, MUTED, blank_figure, headline, legend, style_axes
from sagemp_cli.storage import Artifact, PlannerModel, TrackerModel


def draw_training(artifact: Artifact[PlannerModel] | Artifact[TrackerModel]) -> Figure:
    """Every recorded figure over the updates: faint as measured, strong as a running mean."""
    record = artifact.record
    figure = blank_figure(9.5, 4.6)
    axes = figure.add_subplot()
    draw_curves(axes, artifact)
    text = "\n".join(f"{n}   {v:.4g}" for n, v in zip(record.figure_names, record.figures, strict=True))
    axes.text(
        0.985, 0.97, text, transform=axes.transAxes, ha="right", va="top", fontsize=8.5, color=INK, family="monospace"
    )
    what = artifact.header.stage.replace("train-", "")
    parameters = sum(int(np.prod(w.shape)) for w in record.weights.values())
    headline(
        figure,
        f"Training of the {what}",
        f"{artifact.header.experiment}, {len(record.curve.step)} updates in {artifact.header.seconds:.0f} s; "
        f"{parameters} numbers in the model",
    )
    return figure


def draw_curves(axes, artifact: Artifact[PlannerModel] | Artifact[TrackerModel]) -> None:
    """The curves that are positive throughout, on a logarithmic axis."""
    curve = artifact.record.curve
    style_axes(axes, xlabel="update", ylabel="loss")
    shown = [
        (name, column)
        for name, column in zip(curve.names, curve.values.T, strict=True)
        if name == "loss" or (np.isfinite(column).any() and (column[np.isfinite(column)] > 0).all())
    ]
    for i, (name, column) in enumerate(shown):
        colour, measured = MODES[i % len(MODES)], np.isfinite(column)
        x, y = curve.step[measured], column[measured]
        if len(y) < 0.5 * len(column) or len(y) < 50:
            axes.plot(x, y, color=colour, linewidth=1.6, marker="o", markersize=3, label=name)
            continue
        axes.plot(x, y, color=colour, linewidth=0.5, alpha=0.3)
        window = max(1, len(y) // 50)
        smooth = np.convolve(y, np.ones(window) / window, mode="valid")
        axes.plot(x[window - 1 :], smooth, color=colour, linewidth=1.6, label=name)
    if all((column[np.isfinite(column)] > 0).all() for _, column in shown):
        axes.set_yscale("log")
    axes.grid(color=MUTED, alpha=0.15, which="minor", linewidth=0.4)
    legend(axes, loc="lower left", ncols=3)
