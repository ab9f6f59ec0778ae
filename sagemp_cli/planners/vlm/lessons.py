"""Teaching the local stand-in: the loss on random scenes, and the figures on held-out ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy

from sagemp_cli.planners.vlm.network import SceneReader
from sagemp_cli.planners.vlm.practice import SQUARE, Exercise, Practice, picture
from sagemp_cli.planners.vlm.search import waypoints_on
from sagemp_cli.planners.vlm.words import WORDS, bag_of_words
from sagemp_cli.scenes.frame import Frame
from sagemp_cli.scenes.scene import Scene

OVER_WEIGHT = 5.0
"""A thing covers few cells of a map, so each counts more."""

SPACING = 0.01
"""Of the places on a way that are looked at, in a square of side 2."""


@dataclass(frozen=True)
class Lessons:
    """The loss of the training loop: cross entropy of both maps, and of the names of things, on random batches.

    The names are no answer, but who can name the things learns quickly what an instruction means for them.

    Attributes:
        practice: pictures and maps to learn from.
        batch: rows per update.
    """

    practice: Practice
    batch: int

    def __call__(self, module: nn.Module, step: int, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        """The loss of one batch, and its parts."""
        rows = torch.randint(len(self.practice.images), (self.batch,), generator=generator)
        maps, names = module(self.practice.images[rows], self.practice.words[rows])
        there = (self.practice.names[rows][:, None] == torch.arange(len(WORDS))[:, None, None]).float()
        naming = cross_entropy(names, there, pos_weight=torch.tensor(OVER_WEIGHT))
        blocked = cross_entropy(maps[:, 0], self.practice.blocked[rows])
        over = cross_entropy(maps[:, 1], self.practice.over[rows], pos_weight=torch.tensor(OVER_WEIGHT))
        parts = {"avoid": blocked, "pass over": over, "naming": naming}
        return blocked + over + naming, {name: float(part.detach()) for name, part in parts.items()}


@torch.no_grad()
def answers_to(
    reader: SceneReader,
    asked: Sequence[tuple[Scene, Frame, str, np.ndarray, np.ndarray]],
    *,
    temperature: float,
    rng: np.random.Generator,
) -> list[np.ndarray]:
    """Waypoints ``(J, 2)`` for questions (scene, frame, text, start, goal), all in the square from -1 to 1.

    A picture and text that several questions share are looked at once.
    """
    looked_at: dict[tuple[int, str], int] = {}
    for scene, _, text, _, _ in asked:
        looked_at.setdefault((id(scene), text), len(looked_at))
    distinct = {looked_at[id(scene), text]: (scene, frame, text) for scene, frame, text, _, _ in asked}
    maps = []
    for row in range(0, len(distinct), 64):
        part = [distinct[i] for i in range(row, min(row + 64, len(distinct)))]
        images = torch.from_numpy(np.stack([picture(scene, frame, reader.pixels) for scene, frame, _ in part]))
        maps.append(torch.sigmoid(reader(images, torch.stack([bag_of_words(text) for _, _, text in part]))[0]))
    seen = torch.cat(maps).double().numpy()
    found = []
    for scene, _, text, start, goal in asked:
        blocked, over = seen[looked_at[id(scene), text]]
        found.append(waypoints_on(blocked, over, start, goal, temperature=temperature, rng=rng))
    return found


def answer_figures(reader: SceneReader, exercises: Sequence[Exercise], *, seed: int) -> dict[str, float]:
    """How good one answer to each of held-out exercises is, as a polyline that nothing tracks.

    Returns:
        ``collision-free``: share that keeps clear of what the instruction says to avoid and of the walls;
        ``passes over``: share of those told to pass over something that do.
    """
    asked = [(e.scene, SQUARE, e.instruction, np.array(e.start), np.array(e.goal)) for e in exercises]
    rng = np.random.default_rng(seed)
    clear, over = [], []
    for exercise, waypoints in zip(exercises, answers_to(reader, asked, temperature=0.3, rng=rng), strict=True):
        corners = np.concatenate([[exercise.start], waypoints, [exercise.goal]])
        path = torch.from_numpy(along(corners))
        free = Scene(exercise.scene.workspace, exercise.avoid, exercise.scene.goal)
        clear.append(bool((free.signed_distance(path) > 0).all()))
        if exercise.over is not None:
            over.append(bool((exercise.over.signed_distance(path) < 0).any()))
    figures = {"collision-free": float(np.mean(clear))}
    return figures | ({"passes over": float(np.mean(over))} if over else {})


def along(corners: np.ndarray) -> np.ndarray:
    """Places on a polyline ``(C, 2)``, at most :data:`SPACING` apart."""
    pieces = []
    for a, b in zip(corners[:-1], corners[1:], strict=True):
        count = max(2, int(np.ceil(np.linalg.norm(b - a) / SPACING)) + 1)
        pieces.append(a + np.linspace(0, 1, count)[:, None] * (b - a))
    return np.concatenate(pieces)
