"""Random scenes with instructions, drawn as pictures: what the local stand-in is trained and tested on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.planners.vlm.network import cell_middles
from sagemp_cli.planners.vlm.prompts import template
from sagemp_cli.planners.vlm.words import WORDS, bag_of_words
from sagemp_cli.scenes.frame import Frame
from sagemp_cli.scenes.objects import OBJECTS
from sagemp_cli.scenes.render import render
from sagemp_cli.scenes.scene import Ball, Scene
from sagemp_cli.sets import Box

AVOID_ALL = ("avoid all obstacles", "avoid all food", "avoid all food and drink items")
EXCEPT = ("avoid all food except the {thing}", "all obstacles except the {thing} must be avoided")
PASS_OVER = ("avoid all food except the {thing}; pass over the {thing}",)
"""Instructions beside the paper's prompts, which are practised as well, with any thing in the burger's place."""

_SQUARE = Box(torch.tensor([-1.0, -1.0]), torch.tensor([1.0, 1.0]))
SQUARE = Frame.of(_SQUARE)
"""The picture's coordinates in practice: metres and image coordinates are the same."""


@dataclass(frozen=True)
class Exercise:
    """A random scene in the square from -1 to 1, an instruction, and what the instruction means there.

    Attributes:
        scene: all things as obstacles, as they are drawn.
        instruction: what is said.
        avoid: the obstacles that must be kept clear of.
        over: the one to pass over, None where nothing must.
        start, goal: places.
    """

    scene: Scene
    instruction: str
    avoid: tuple[Ball, ...]
    over: Ball | None
    start: tuple[float, float]
    goal: tuple[float, float]


@dataclass(frozen=True)
class Practice:
    """Exercises as tensors, one row each.

    Attributes:
        images: ``(B, 3, pixels, pixels)``, uint8.
        words: ``(B, words)``.
        blocked: where not to be, ``(B, pixels / 2, pixels / 2)``: closer than the margin to what must be avoided.
        over: what to pass over, the same shape.
        names: what is there, ``(B, pixels / 2, pixels / 2)``: index into WORDS, -1 where nothing is.
    """

    images: Tensor
    words: Tensor
    blocked: Tensor
    over: Tensor
    names: Tensor


def random_exercise(rng: np.random.Generator) -> Exercise:
    """A scene with three to nine things, start on the left and goal on the right, and an instruction.

    Two in five instructions are to avoid everything, two in five to pass over one thing, the rest only allow to. One
    scene in seven holds plain blue discs instead of food.
    """
    start = (float(rng.uniform(-0.95, -0.6)), float(rng.uniform(-0.7, 0.7)))
    goal = (float(rng.uniform(0.6, 0.95)), float(rng.uniform(-0.7, 0.7)))
    plain, names, wanted = rng.random() < 1 / 7, list(OBJECTS), int(rng.integers(3, 10))
    things: list[Ball] = []
    for _ in range(8 * wanted):
        radius, center = float(rng.uniform(0.09, 0.18)), rng.uniform(-0.88, 0.88, 2)
        clear = all(np.linalg.norm(center - np.array(t.center)) > radius + t.radius + 0.08 for t in things)
        if clear and min(np.linalg.norm(center - np.array(end)) for end in (start, goal)) > radius + 0.15:
            name = "" if plain else names[int(rng.integers(len(names)))]
            things.append(Ball((float(center[0]), float(center[1])), radius, object=name))
        if len(things) == wanted:
            break
    scene = Scene(_SQUARE, tuple(things), _SQUARE)
    if plain:
        return Exercise(scene, template("blue_circles"), tuple(things), None, start, goal)
    # Only what occurs once can be spoken of as "the".
    seen = [t.object for t in things]
    single = [t for t in things if seen.count(t.object) == 1]
    chance = rng.random()
    if chance < 0.4 or not single:
        texts = (*AVOID_ALL, template("avoid_food"))
        return Exercise(scene, texts[int(rng.integers(len(texts)))], tuple(things), None, start, goal)
    thing = single[int(rng.integers(len(single)))]
    over = chance < 0.8
    texts = (*PASS_OVER, template("over_burger").replace("burger", "{thing}")) if over else EXCEPT
    instruction = texts[int(rng.integers(len(texts)))].replace("{thing}", thing.object)
    avoid = tuple(t for t in things if t is not thing)
    return Exercise(scene, instruction, avoid, thing if over else None, start, goal)


def practice_of(exercises: list[Exercise], *, pixels: int, margin: float) -> Practice:
    """Exercises as pictures and maps; ``margin`` is the distance to keep, in the picture's units."""
    cells = cell_middles(pixels // 2).numpy()

    def near(things: tuple[Ball, ...], margin: float) -> np.ndarray:
        apart = [np.linalg.norm(cells - np.array(t.center), axis=-1) - t.radius for t in things]
        return np.minimum.reduce([np.full(cells.shape[:2], np.inf), *apart]) < margin

    names = np.full((len(exercises), *cells.shape[:2]), -1)
    for row, exercise in zip(names, exercises, strict=True):
        for thing in exercise.scene.obstacles:
            assert isinstance(thing, Ball)
            row[near((thing,), 0.0)] = WORDS.index(thing.object or "circles")
    images = np.stack([picture(e.scene, SQUARE, pixels) for e in exercises])
    return Practice(
        torch.from_numpy(images),
        torch.stack([bag_of_words(e.instruction) for e in exercises]),
        torch.from_numpy(np.stack([near(e.avoid, margin) for e in exercises])).float(),
        torch.from_numpy(np.stack([near(() if e.over is None else (e.over,), 0.0) for e in exercises])).float(),
        torch.from_numpy(names),
    )


def picture(scene: Scene, frame: Frame, pixels: int) -> np.ndarray:
    """A scene as the network sees it, ``(3, pixels, pixels)``: without the dots, whose places are told in numbers."""
    nowhere = (0.0, 0.0)
    image = render(scene, frame, start=nowhere, goal=nowhere, height=pixels, dots=False)
    return np.ascontiguousarray(image.transpose(2, 0, 1))
