"""The stand-in's parts: words, exercises, maps, the search on them, and that a little practice teaches something."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from sagemp_cli.learning.fit import fit
from sagemp_cli.learning.schedule import Schedule
from sagemp_cli.planners.vlm.lessons import Lessons, along, answers_to
from sagemp_cli.planners.vlm.network import SceneReader, cell_middles
from sagemp_cli.planners.vlm.practice import SQUARE, Exercise, practice_of, random_exercise
from sagemp_cli.planners.vlm.prompts import template
from sagemp_cli.planners.vlm.search import waypoints_on
from sagemp_cli.planners.vlm.words import WORDS, bag_of_words
from sagemp_cli.scenes import Ball, Scene

START, GOAL = np.array([-0.8, 0.0]), np.array([0.8, 0.0])
FREE = np.zeros((24, 24))


def discs(*places, radius=0.25):
    cells = cell_middles(24).numpy()
    return np.max([np.linalg.norm(cells - np.array(p), axis=-1) < radius for p in places], axis=0).astype(float)


def search(blocked, over=FREE, *, temperature=0.0, seed=0):
    rng = np.random.default_rng(seed)
    waypoints = waypoints_on(blocked, over, START, GOAL, temperature=temperature, rng=rng)
    return np.concatenate([[START], waypoints, [GOAL]])


def test_words_are_found_whatever_stands_around_them():
    found = bag_of_words("Avoid all FOOD, except the *burger*; overtake nothing.")
    assert {w for w, there in zip(WORDS, found.tolist()) if there} == {"avoid", "food", "except", "burger"}


def test_the_papers_prompts_differ_in_words_that_the_stand_in_knows():
    said = [bag_of_words(template(name)) for name in ("avoid_food", "over_burger", "blue_circles")]
    assert not torch.equal(said[0], said[1]) and not torch.equal(said[0], said[2])
    assert float(said[1][WORDS.index("over")]) == 1 and float(said[0][WORDS.index("over")]) == 0


def test_on_a_free_map_the_way_is_straight():
    path = along(search(FREE))
    assert np.abs(path[:, 1]).max() < 0.06


def test_the_way_keeps_out_of_what_is_blocked():
    blocked = discs((0.0, 0.05))
    path = along(search(blocked))
    assert np.linalg.norm(path - [0.0, 0.05], axis=1).min() > 0.22
    assert path[:, 1].min() < -0.1  # the shorter side


def test_the_way_passes_over_what_it_is_told_to():
    path = along(search(discs((0.0, 0.0)), discs((0.1, 0.6), radius=0.12)))
    assert np.linalg.norm(path - [0.1, 0.6], axis=1).min() < 0.06


def test_diversity_takes_both_sides_of_an_obstacle():
    ways = [along(search(discs((0.0, 0.0)), temperature=1.0, seed=seed)) for seed in range(12)]
    sides = [np.sign(w[np.abs(w[:, 0]).argmin(), 1]) for w in ways]
    assert {-1.0, 1.0} == set(sides)


def test_a_way_through_a_wall_is_better_than_none():
    wall = np.zeros((24, 24))
    wall[:, 12] = 1.0
    assert np.isfinite(search(wall)).all()


def test_an_exercise_means_what_its_instruction_says():
    rng = np.random.default_rng(0)
    kinds = set()
    for _ in range(200):
        e = random_exercise(rng)
        words = bag_of_words(e.instruction)
        exempt = [t for t in e.scene.obstacles if t not in e.avoid]
        assert len(exempt) == int(words[WORDS.index("except")])
        assert (e.over is not None) == bool(words[WORDS.index("over")])
        assert all(bool(words[WORDS.index(t.object)]) for t in exempt)
        ends = torch.tensor([e.start, e.goal], dtype=torch.float64)
        assert bool((e.scene.signed_distance(ends) > 0).all())
        kinds.add((len(exempt), e.over is not None, e.scene.obstacles[0].object == ""))
    assert kinds == {(0, False, False), (0, False, True), (1, False, False), (1, True, False)}


def test_the_maps_to_learn_are_those_of_the_geometry():
    burger = Ball((0.5, 0.5), 0.2, object="burger")
    apple = Ball((-0.4, 0.0), 0.15, object="apple")
    scene = Scene(SQUARE_BOX, (burger, apple), SQUARE_BOX)
    exercise = Exercise(
        scene, "avoid all food except the burger; pass over the burger", (apple,), burger, (0, 0), (0, 0)
    )
    practice = practice_of([exercise], pixels=48, margin=0.1)
    cells = cell_middles(24)
    assert torch.equal(practice.blocked[0] > 0, (cells - torch.tensor([-0.4, 0.0])).norm(dim=-1) < 0.25)
    assert torch.equal(practice.over[0] > 0, (cells - torch.tensor([0.5, 0.5])).norm(dim=-1) < 0.2)
    seen = [WORDS[i] for i in practice.names[0].unique().tolist() if i >= 0]
    assert sorted(seen) == ["apple", "burger"]
    assert practice.images.shape == (1, 3, 48, 48) and practice.images.dtype == torch.uint8


SQUARE_BOX = random_exercise(np.random.default_rng(0)).scene.workspace


def test_practice_lowers_the_loss():
    generator, rng = torch.Generator().manual_seed(0), np.random.default_rng(0)
    practice = practice_of([random_exercise(rng) for _ in range(32)], pixels=32, margin=0.1)
    reader = SceneReader(pixels=32, channels=8)
    reader.reset(generator)
    history = fit(reader, Lessons(practice, 8), Schedule(steps=24, learning_rate=1e-2), generator=generator)
    assert history.loss[-4:].mean() < 0.7 * history.loss[:2].mean()
    assert set(history.figures) == {"avoid", "pass over", "naming"}


def test_questions_about_one_picture_are_looked_at_once(monkeypatch):
    reader, calls = SceneReader(pixels=32, channels=8).eval(), []
    forward = reader.forward
    monkeypatch.setattr(reader, "forward", lambda images, words: calls.append(len(images)) or forward(images, words))
    exercise = random_exercise(np.random.default_rng(1))
    asked = [(exercise.scene, SQUARE, exercise.instruction, START, GOAL)] * 5
    found = answers_to(reader, asked, temperature=0.3, rng=np.random.default_rng(0))
    assert len(found) == 5 and calls == [1]


@pytest.mark.parametrize("place", [(0.99, 0.99), (-1.0, -1.0), (1.2, 0.0)])
def test_ends_at_or_beyond_the_edge_are_put_up_with(place):
    found = waypoints_on(
        FREE, FREE, np.array([-0.5, 0.0]), np.array(place), temperature=0.5, rng=np.random.default_rng(0)
    )
    assert np.isfinite(found).all() and len(found) >= 1


def test_a_way_that_would_turn_back_where_it_passes_over_is_drawn_anew(monkeypatch):
    place = np.array([0.25, 0.3])
    walls, over = discs((-0.05, 0.0), (-0.35, 0.3), (0.05, 0.6), radius=0.22), discs(place, radius=0.12)

    def turn_back(seed):
        corners = search(walls, over, temperature=0.8, seed=seed)
        at = int(np.linalg.norm(corners - place, axis=1).argmin())
        before, after = np.diff(corners[at - 1 : at + 2], axis=0)
        return before @ after <= -0.5 * np.linalg.norm(before) * np.linalg.norm(after)

    assert not any(turn_back(seed) for seed in range(12))
    monkeypatch.setattr("sagemp_cli.planners.vlm.search.TRIES", 1)
    assert any(turn_back(seed) for seed in range(12))
