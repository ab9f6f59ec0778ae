"""Figure: what was proved. The tube in the workspace, every state over time, the clearance at every step."""

from __future__ import annotations

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d import Axes3D

from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.pipeline.problem import problem_of
from sagemp_cli.pipeline.tubes import flows_of
from sagemp_cli.problem import Problem
from sagemp_cli.report.canvas import (
    DANGER,
    GOAL,
    INK,
    MODES,
    MUTED,
    REFERENCE,
    UNKNOWN,
    VERDICT_COLOURS,
    blank_figure,
    broken_at,
    draw_boxes,
    draw_scene,
    goal_at_end,
    headline,
    legend_above,
    plane_of,
    shown_steps,
    state_label,
    style_axes,
    subject,
    time_bar,
    tube_boxes,
)
from sagemp_cli.report.space import space_axes, space_tube
from sagemp_cli.sets import Between, Box, Bulge, Tube, over_steps
from sagemp_cli.sets.between import moment
from sagemp_cli.storage import Artifact, Certificate, Tubes

_SAYS = {
    "VERIFIED": "Certified {when}: every start in X$_I$ stays clear and reaches the goal",
    "FALSIFIED": "Falsified: a replayed counterexample breaks the claim",
    "UNKNOWN": "Unknown: the tube does not prove it, and no counterexample was found",
}


def draw_certificate(artifact: Artifact[Certificate]) -> Figure:
    """Tube to scale on the left; states with their bounds, and the certified clearance, over time on the right."""
    record, problem = artifact.record, problem_of(artifact.header.config)
    tubes, dynamics = record.tubes, problem.dynamics
    count, horizon = len(tubes.verdict), tubes.tube_lower.shape[1] - 1
    shown, flat = list(range(dynamics.state_dim)), len(dynamics.position) == 2
    columns = 1 if dynamics.state_dim <= 8 else 2
    rows = -(-(len(shown) + 1) // columns)
    figure = blank_figure(12 + 2.2 * columns, max(7.2, 1.4 * rows))
    grid = figure.add_gridspec(rows, 1 + columns, width_ratios=(2.05, *[1] * columns))

    scene = figure.add_subplot(grid[:, 0]) if flat else space_axes(figure, grid[:, 0], problem)
    if flat:
        draw_scene(scene, problem)
    for r in range(count):
        if isinstance(scene, Axes3D):
            space_tube(scene, problem, tubes, r)
        else:
            draw_tube(scene, problem, tubes, r)
    for example in record.counterexamples:
        path = example.states[:, list(dynamics.position)]
        scene.plot(*path.T, color=DANGER, linewidth=1.6, zorder=8)
        scene.scatter(
            *broken_at(path, example), s=46, marker="X", color=DANGER, edgecolor="white", linewidth=0.6, zorder=9
        )
    handles = [
        Line2D([], [], color=REFERENCE, lw=1.2, ls=(0, (4, 2)), label="reference"),
        Line2D([], [], color=INK, lw=0.9, marker="s", mfc="none", ms=7, ls="", label="start cells"),
    ]
    if record.counterexamples:
        handles.append(Line2D([], [], color=DANGER, lw=1.6, marker="X", label="counterexample"))
    legend_above(scene, handles)
    time_bar(figure, scene, horizon * dynamics.dt)

    times, panels = dynamics.dt * np.arange(horizon + 1), []
    for place, state in enumerate(shown):
        axes = figure.add_subplot(grid[place % rows, 1 + place // rows], sharex=panels[0] if panels else None)
        panels.append(axes)
        last = place % rows == rows - 1
        style_axes(axes, ylabel=state_label(problem, state), xlabel="time (s)" if last else "")
        axes.tick_params(labelbottom=last)
        for r in range(count):
            _band(axes, times, problem, tubes, r, state)
        for example in record.counterexamples:
            axes.plot(times, example.states[:, state], color=DANGER, linewidth=1.2, zorder=8)
        goal_at_end(axes, problem, state, times[-1])
    handles = [
        Patch(facecolor=MODES[0], alpha=0.35, label="tube of each cell"),
        Line2D([], [], color=GOAL, lw=4, label="goal at the end"),
    ]
    legend_above(panels[0], handles)
    axes = figure.add_subplot(grid[-1, -1], sharex=panels[0])
    _clearances(axes, times, problem, tubes)
    axes.set_xlim(0, times[-1])
    figure.align_ylabels([*panels, axes])

    cells = len(tubes.cell_reference)
    proof = "rounding included" if tubes.rigorous else "sound in exact arithmetic"
    headline(
        figure,
        _SAYS.get(record.verdict, record.verdict).format(when=Between(tubes.between).words),
        f"{subject(artifact.header)}: {_deciding(tubes, dynamics.dt)}; {count} reference{'s' * (count > 1)}, "
        f"{cells} cell{'s' * (cells > 1)}, K = {horizon} ({horizon * dynamics.dt:g} s), "
        f"{tubes.propagator} in {tubes.seconds.sum():.2g} s, {proof}; "
        f"{record.falsifier_rollouts} rollouts attacked it{_about_model(record, dynamics)}",
        colour=VERDICT_COLOURS.get(record.verdict, INK),
    )
    return figure


def draw_tube(axes: Axes, problem: Problem, tubes: Tubes, reference: int, *, alpha: float = 0.3) -> None:
    """One reference in the workspace: cross-sections of its cells' tubes, its start cells, and itself."""
    mine, plane = tubes.cell_reference == reference, plane_of(problem)
    steps = shown_steps(problem, tubes.tube_lower[mine], tubes.tube_upper[mine])
    lower, upper = tubes.tube_lower[mine][:, :steps, plane], tubes.tube_upper[mine][:, :steps, plane]
    tube_boxes(axes, lower, upper, alpha=alpha / np.sqrt(max(1, len(lower) / 4)), of=tubes.tube_lower.shape[1])
    draw_boxes(
        axes,
        tubes.cell_lower[mine][:, plane],
        tubes.cell_upper[mine][:, plane],
        facecolors="none",
        edgecolors=INK,
        linewidths=float(np.clip(6 / np.sqrt(len(lower)), 0.3, 0.9)),
        zorder=5,
    )
    assert tubes.references is not None
    path = tubes.references[reference][:, plane]
    axes.plot(*path.T, color=REFERENCE, linewidth=1.2, linestyle=(0, (4, 2)), zorder=7)


def _band(axes: Axes, times: np.ndarray, problem: Problem, tubes: Tubes, reference: int, state: int) -> None:
    """Bounds of one state, cell by cell; where the tube outgrows the workspace it ends at a dashed line."""
    mine, colour = tubes.cell_reference == reference, MODES[reference % len(MODES)]
    steps = shown_steps(problem, tubes.tube_lower[mine], tubes.tube_upper[mine])
    lower, upper = tubes.tube_lower[mine][:, :steps, state], tubes.tube_upper[mine][:, :steps, state]
    if steps:
        across = np.concatenate([times[:steps], times[:steps][::-1]])
        around = np.concatenate([lower, upper[:, ::-1]], axis=1)
        outlines = np.stack([np.broadcast_to(across, around.shape), around], axis=-1)
        alpha = 0.15 / np.sqrt(max(1, len(lower) / 9))
        axes.add_collection(PolyCollection(list(outlines), color=colour, alpha=alpha, linewidth=0), autolim=False)
        axes.plot(times[:steps], lower.min(0), color=colour, linewidth=0.9)
        axes.plot(times[:steps], upper.max(0), color=colour, linewidth=0.9)
    if steps < len(times):
        axes.axvline(times[steps], color=UNKNOWN, linewidth=1.1, linestyle=(0, (2, 2)))
    assert tubes.references is not None
    axes.plot(times, tubes.references[reference, :, state], color=REFERENCE, linewidth=1.0, linestyle=(0, (4, 2)))


def _clearances(axes: Axes, times: np.ndarray, problem: Problem, tubes: Tubes) -> None:
    """Certified distance of the tubes to every constraint over each step; not above the red line nothing is proved."""
    index = list(problem.dynamics.position)
    tube = Tube(torch.from_numpy(tubes.tube_lower), torch.from_numpy(tubes.tube_upper))
    lines, bulge, steps = tube, None, tube.horizon
    if tubes.flow is not None:
        ((_, flow),) = flows_of(tubes.flow, tube)  # all cells are divided alike
        lines, bulge = flow.lines(tube, problem.disturbance, problem.dynamics.dt)
        bulge = Bulge(*(part[..., index] for part in (bulge.curve, bulge.swing, bulge.rest)))
    lower = torch.nan_to_num(lines.lower[..., index], nan=-torch.inf, posinf=-torch.inf)
    upper = torch.nan_to_num(lines.upper[..., index], nan=torch.inf, neginf=torch.inf)
    parts = over_steps(Tube(lower, upper), bulge)
    least = problem.scene.clearances(Box(parts.lower, parts.upper)).amin((0, 2))
    found = least.unflatten(0, (steps, -1)).amin(1).numpy()
    style_axes(axes, xlabel="time (s)", ylabel="clearance (m)")
    names = list(tubes.constraint_names)
    if len(names) > 4:  # too many lines to tell apart
        found, names = np.stack([found[:, 0], found[:, 1:].min(1)], axis=1), [names[0], "nearest obstacle"]
    steps = shown_steps(problem, tubes.tube_lower, tubes.tube_upper)
    lines = [axes.axhline(0, color=DANGER, linewidth=1.1, label="contact")]
    found = np.concatenate([found, found[-1:]])  # of each step up to its end
    for i, name in enumerate(names):
        colour = MUTED if i == 0 else MODES[(i - 1) % len(MODES)]
        lines += axes.step(times[:steps], found[:steps, i], where="post", color=colour, linewidth=1.3, label=name)
    if steps < len(times):
        axes.axvline(times[steps], color=UNKNOWN, linewidth=1.1, linestyle=(0, (2, 2)))
    finite = found[:steps][np.isfinite(found[:steps])]
    least, most = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    axes.set_ylim(max(-1.0, min(0.0, least)) - 0.1, min(3.0, 1.1 * max(most, 0.1)))
    legend_above(axes, lines)


def _about_model(record: Certificate, dynamics: Dynamics) -> str:
    """Of a learned robot, what is proved of the model that it was learned from; nothing of others."""
    if dynamics.analytical is dynamics:
        return ""
    model = type(dynamics.analytical).__name__
    said = f"robot: a network learned from {model}"
    if record.true_model is None:
        return f"; {said}"
    found = sorted(set(record.true_model.tubes.verdict))
    return f"; {said}, {model} itself: {', '.join(found)} with {len(record.true_model.tubes.cell_reference)} cells"


def _deciding(tubes: Tubes, dt: float) -> str:
    """The verdict of the worst reference, in words."""
    words = Between(tubes.between).words
    open_ones = [r for r, v in enumerate(tubes.verdict) if v != "SAFE"]
    if open_ones:
        r = open_ones[0]
        when = moment(int(tubes.step[r]), float(tubes.fraction[r]), dt)
        return f"{tubes.verdict[r]} at {when} ({tubes.constraint[r]})"
    r, c = np.unravel_index(tubes.clearance.argmin(), tubes.clearance.shape)
    return f"SAFE {words}, passes {tubes.constraint_names[c]} at {tubes.clearance[r, c]:.2f} m or more"
