"""Figure: what the planner proposes from starts all over the start box, and how it was trained."""

from __future__ import annotations

from collections import Counter

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sagemp_cli.pipeline.models import planner_from
from sagemp_cli.pipeline.problem import problem_of
from sagemp_cli.planners.base import affordable
from sagemp_cli.report.canvas import (
    DANGER,
    MODES,
    MUTED,
    blank_figure,
    draw_paths,
    draw_scene,
    draw_start,
    headline,
    legend_above,
    plane_of,
)
from sagemp_cli.report.training import draw_losses, draw_validation
from sagemp_cli.scenes.sides import side_label, sides_of
from sagemp_cli.storage import Artifact, PlannerModel

SAMPLES = 80
"""References drawn for the picture, if the planner can afford them."""

CURVES = ("collision-free", "passes over", "in goal", "start error", "goal error", "share ")
"""How the names of those validation figures begin that are shown: shares, and metres that are small."""


def draw_planner(artifact: Artifact[PlannerModel]) -> Figure:
    """Samples to scale by the sides on which they pass the obstacles, those in collision in red.

    Beside them the losses and the validation curve, where the planner was trained.
    """
    problem, planner = problem_of(artifact.header.config), planner_from(artifact)
    generator = torch.Generator().manual_seed(artifact.header.seed)
    count = affordable(planner, SAMPLES)
    references = planner.sample(
        problem.start.sample(count, generator),
        problem.scene.goal,
        scene=problem.scene,
        count=count,
        generator=generator,
    )
    position = list(problem.dynamics.position)
    clear = (problem.scene.signed_distance_along(references[..., position]) > 0).all(-1).numpy()
    reaches = problem.scene.goal.contains(references[:, -1]).numpy()
    paths = references[..., plane_of(problem)].numpy()
    places = references[..., position].numpy()
    sides = np.array([side_label(sides_of(path, problem.scene.obstacles), len(position)) for path in places])

    trained = len(artifact.record.curve.step) > 0
    figure = blank_figure(13 if trained else 9, 5.2)
    grid = figure.add_gridspec(2, 2, width_ratios=(2.3, 1)) if trained else figure.add_gridspec(2, 1)
    scene = figure.add_subplot(grid[:, 0])
    draw_scene(scene, problem)
    draw_start(scene, problem)
    handles = []
    for i, (side, _) in enumerate(Counter(sides[clear]).most_common()):
        shown, colour = paths[clear & (sides == side)], MODES[i % len(MODES)]
        draw_paths(scene, shown, colors=colour, linewidths=0.9, alpha=0.45)
        handles.append(Line2D([], [], color=colour, lw=2, label=f"{side or 'collision-free'}: {len(shown)}"))
    draw_paths(scene, paths[~clear], colors=DANGER, linewidths=0.9, alpha=0.7)
    handles.append(Line2D([], [], color=DANGER, lw=2, label=f"in collision: {int((~clear).sum())}"))
    scene.scatter(*paths[:, 0].T, s=6, color=MUTED, linewidths=0, zorder=4)
    legend_above(scene, handles)
    if trained:
        draw_losses(figure.add_subplot(grid[0, 1]), artifact)
        draw_validation(figure.add_subplot(grid[1, 1]), artifact, only=CURVES)
    label = getattr(planner, "label", f"{type(planner).__name__} planner")
    headline(
        figure,
        f"{label}: {100 * clear.mean():.0f} % of its plans are collision-free",
        f"{artifact.header.experiment}, {count} samples from starts drawn in X$_I$, K = {references.shape[1] - 1}; "
        f"{100 * reaches.mean():.0f} % end in the goal box; open loop, nothing tracks them; "
        "L, R: sides of the obstacles",
    )
    return figure
