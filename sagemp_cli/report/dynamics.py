"""Figure: how well a learned robot predicts, and how it came to that."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullFormatter

from sagemp_cli.config.binding import build
from sagemp_cli.report.canvas import INK, MODES, MUTED, blank_figure, headline, legend, style_axes, unit_text
from sagemp_cli.report.training import draw_losses
from sagemp_cli.storage import Artifact, DynamicsModel

_VALIDATION = "validation "


def draw_dynamics(artifact: Artifact[DynamicsModel]) -> Figure:
    """A histogram of each state's errors on unseen transitions; the losses; the validation errors over the updates."""
    record, robot = artifact.record, build(artifact.header.config["dynamics"], "dynamics")
    names, units = robot.state_names, robot.state_units
    columns = 2 if len(names) <= 6 else 3
    rows = -(-len(names) // columns)
    figure = blank_figure(13, max(4.8, 1.7 * rows + 1.4))
    sides = figure.add_gridspec(1, 2, width_ratios=(1.5, 1))
    grid = sides[0].subgridspec(rows, columns)
    for i, (name, unit) in enumerate(zip(names, units, strict=True)):
        label = f"{name}' ({unit_text(unit, per_second=True)})"
        _draw_errors(figure.add_subplot(grid[i // columns, i % columns]), record, i, label)
    curves = sides[1].subgridspec(2, 1)
    draw_losses(figure.add_subplot(curves[0]), artifact)
    _draw_validation(figure.add_subplot(curves[1]), record)
    widths = " x ".join(str(layer.out_features) for layer in list(robot.layers)[:-1])
    headline(
        figure,
        "A learned robot model",
        f"{artifact.header.experiment}, hidden {widths}, {robot.activation}; {int(record.error_counts[0].sum())} unseen"
        f" transitions; trained in {artifact.header.seconds:.0f} s",
    )
    return figure


def _draw_errors(axes: Axes, record: DynamicsModel, i: int, label: str) -> None:
    style_axes(axes, xlabel=f"error of {label}", ylabel="transitions")
    edges, counts = record.error_edges[i], record.error_counts[i]
    axes.bar(edges[:-1], counts, width=np.diff(edges), align="edge", color=MODES[0], alpha=0.75)
    axes.set_yscale("log")
    axes.xaxis.set_major_locator(MaxNLocator(3, min_n_ticks=2))
    found = f"rms {record.error_rms[i]:.2g}, largest {record.error_max[i]:.2g}"
    axes.set_title(found, fontsize=8.5, color=INK, loc="left", pad=3)


def _draw_validation(axes: Axes, record: DynamicsModel) -> None:
    style_axes(axes, xlabel="update", ylabel="rms error, unseen")
    curve = record.curve
    found = [name for name in curve.names if name.startswith(_VALIDATION)]
    for i, name in enumerate(found):
        column = curve.values[:, curve.names.index(name)]
        known = np.isfinite(column)
        style = {"color": MODES[i % len(MODES)], "linestyle": "-" if i < len(MODES) else (0, (4, 2))}
        label = name.removeprefix(_VALIDATION).removesuffix(" error")
        axes.plot(curve.step[known], column[known], marker="o", markersize=3, linewidth=1.2, label=label, **style)
    axes.set_yscale("log")
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(color=MUTED, alpha=0.15, which="minor", linewidth=0.4)
    columns = len(found) if len(found) <= 6 else 6
    legend(axes, loc="lower right", bbox_to_anchor=(1.0, 0.995), ncols=columns, borderaxespad=0.1, fontsize=7.5)
