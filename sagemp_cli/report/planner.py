"""Figure: what the planner proposes from starts all over the start box, and how it was trained."""

from __future__ import annotations

import torch
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sagemp_cli.models import planner_from
from sagemp_cli.report.canvas import (
    DANGER,
    MODES,
    MUTED,
    Setting,
    blank_figure,
    draw_paths,
    draw_scene,
    draw_start,
    headline,
    legend_above,
)
from sagemp_cli.report.training import draw_losses, draw_validation
from sagemp_cli.storage import Artifact, PlannerModel

SAMPLES = 80
"""References drawn for the picture."""


def draw_planner(artifact: Artifact[PlannerModel]) -> Figure:
    """Samples to scale, those in collision in red; the training curve beside them."""
    setting, planner = Setting.of(artifact.header.config), planner_from(artifact)
    generator = torch.Generator().manual_seed(artifact.header.seed)
    references = planner.sample(
        setting.start.sample(SAMPLES, generator),
        setting.scene.goal,
        scene=setting.scene,
        count=SAMPLES,
        generator=generator,
    )
    clear = (setting.scene.signed_distance(references[..., list(setting.dynamics.position)]) > 0).all(-1).numpy()
    reaches = setting.scene.goal.contains(references[:, -1]).numpy()
    paths = references[..., setting.plane].numpy()

    figure = blank_figure(13, 5.2)
    grid = figure.add_gridspec(2, 2, width_ratios=(2.3, 1))
    scene = figure.add_subplot(grid[:, 0])
    draw_scene(scene, setting)
    draw_start(scene, setting)
    draw_paths(scene, paths[clear], colors=MODES[0], linewidths=0.9, alpha=0.45)
    draw_paths(scene, paths[~clear], colors=DANGER, linewidths=0.9, alpha=0.7)
    scene.scatter(*paths[:, 0].T, s=6, color=MUTED, linewidths=0, zorder=4)
    handles = [
        Line2D([], [], color=MODES[0], lw=2, label=f"collision-free: {int(clear.sum())}"),
        Line2D([], [], color=DANGER, lw=2, label=f"in collision: {int((~clear).sum())}"),
    ]
    legend_above(scene, handles)
    losses, validation = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1])
    draw_losses(losses, artifact)
    draw_validation(validation, artifact)
    target = artifact.header.config["planner"]["_target_"].rpartition(".")[2]
    headline(
        figure,
        f"{target} planner: {100 * clear.mean():.0f} % of its plans are collision-free",
        f"{artifact.header.experiment}, {SAMPLES} samples from starts drawn in X$_I$, K = {references.shape[1] - 1}; "
        f"{100 * reaches.mean():.0f} % end in the goal box; open loop, nothing tracks them",
    )
    return figure
