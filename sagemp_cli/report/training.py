"""Figure: the course of a training run and the model card."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sagemp_cli.report.canvas import INK, MODES, MUTED, blank_figure, headline, legend, style_axes
from sagemp_cli.storage import Artifact, DynamicsModel, PlannerModel, TrackerModel

_VALIDATION = "validation "


def draw_training(artifact: Artifact[PlannerModel] | Artifact[TrackerModel]) -> Figure:
    """Losses over the updates, faint as measured and strong as a running mean; the model card beside them."""
    record = artifact.record
    figure = blank_figure(9.5, 4.4)
    grid = figure.add_gridspec(1, 2, width_ratios=(2.6, 1))
    draw_losses(figure.add_subplot(grid[0]), artifact)
    card = figure.add_subplot(grid[1])
    card.axis("off")
    card.set_title("at the end", fontsize=10, color=INK, loc="left")
    for i, (name, value) in enumerate(zip(record.figure_names, record.figures, strict=True)):
        y = 0.96 - 0.075 * i
        card.text(0.0, y, name, transform=card.transAxes, fontsize=9, color=MUTED, va="top")
        card.text(1.0, y, f"{value:.4g}", transform=card.transAxes, fontsize=9, color=INK, va="top", ha="right")
    what = artifact.header.stage.replace("train-", "")
    parameters = sum(int(np.prod(w.shape)) for w in record.weights.values())
    headline(
        figure,
        f"Training of the {what}",
        f"{artifact.header.experiment}, {len(record.curve.step)} updates in {artifact.header.seconds:.0f} s; "
        f"{parameters} numbers in the model",
    )
    return figure


def draw_losses(
    axes: Axes, artifact: Artifact[DynamicsModel] | Artifact[PlannerModel] | Artifact[TrackerModel]
) -> None:
    """What every update measured and is positive, on a logarithmic axis."""
    curve = artifact.record.curve
    style_axes(axes, xlabel="update", ylabel="loss")
    losses = [i for i, name in enumerate(curve.names) if not name.startswith(_VALIDATION)]
    shown = [i for i in losses if _positive(curve.values[:, i])]
    for colour, i in zip(MODES, shown, strict=False):
        measured = np.isfinite(curve.values[:, i])
        x, y = curve.step[measured], curve.values[measured, i]
        window = max(1, len(y) // 40)
        smooth = np.convolve(y, np.ones(window) / window, mode="valid")
        axes.plot(x, y, color=colour, linewidth=0.5, alpha=0.3)
        axes.plot(x[window - 1 :], smooth, color=colour, linewidth=1.6, label=curve.names[i])
    if shown:
        axes.set_yscale("log")
        axes.grid(color=MUTED, alpha=0.15, which="minor", linewidth=0.4)
        legend(axes, loc="lower right", bbox_to_anchor=(1.0, 0.995), ncols=len(shown), borderaxespad=0.1, fontsize=8)


def draw_validation(
    axes: Axes, artifact: Artifact[PlannerModel] | Artifact[TrackerModel], *, only: tuple[str, ...] = ("",)
) -> None:
    """The validation's figures whose names begin with one of ``only``, shares and distances alike, on one axis."""
    curve = artifact.record.curve
    style_axes(axes, xlabel="update", ylabel="share, or error in m")
    found = [
        name for name in curve.names if name.startswith(_VALIDATION) and name.removeprefix(_VALIDATION).startswith(only)
    ]
    for colour, name in zip(MODES, found, strict=False):
        column = curve.values[:, curve.names.index(name)]
        measured = np.isfinite(column)
        style = {"color": colour, "linewidth": 1.4, "marker": "o", "markersize": 3}
        label = name.removeprefix(_VALIDATION)
        axes.plot(curve.step[measured], column[measured], label=label, **style)
    axes.set_ylim(0, 1.05)
    if found:
        columns = 3 if max(map(len, found)) <= 30 else 1  # what stands in is named, and takes a line of its own
        legend(axes, loc="lower right", bbox_to_anchor=(1.0, 0.995), ncols=columns, borderaxespad=0.1, fontsize=7.5)


def _positive(column: np.ndarray) -> bool:
    found = column[np.isfinite(column)]
    return len(found) > 0 and bool((found > 0).all())
