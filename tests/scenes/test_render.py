"""Pictures of scenes: coordinates, colours where things are, the same at every size, and files that others read."""

from __future__ import annotations

import io
import re

import numpy as np
import pytest
import torch
from matplotlib.image import imread

from sagemp_cli.config.folders import load_scene
from sagemp_cli.errors import ConfigError
from sagemp_cli.scenes import OBJECTS, Ball, Block, Frame, Landmark, Scene, png_bytes, render, scene_from_mapping
from sagemp_cli.scenes.objects import PLAIN, PLATE
from sagemp_cli.scenes.render import FLOOR, GOAL, OUTSIDE, START
from sagemp_cli.sets import Box

ROOM = Box(torch.tensor([0.0, -1.0]), torch.tensor([4.0, 1.0]))


def picture(*obstacles, landmarks=(), height=120, frame=None, **options):
    scene = Scene(ROOM, obstacles, ROOM, landmarks)
    frame = frame or Frame.of(ROOM, y=(-0.5, 0.5))
    return render(scene, frame, start=[0.5, 0.0], goal=[3.5, 0.0], height=height, **options)


def colour_at(image, place):
    """The colour at a place in metres, for the room's own frame."""
    height, width, _ = image.shape
    column, row = place[0] / 4 * width, (1 - place[1]) / 2 * height
    return tuple(int(v) for v in image[int(row), int(column)])


def test_things_are_where_they_are():
    image = picture(Ball((1.5, 0.4), 0.3), Block((2.0, -0.8), (2.6, -0.3)))
    assert image.shape == (120, 240, 3) and image.dtype == np.uint8
    assert colour_at(image, (1.5, 0.4)) == colour_at(image, (1.7, 0.5)) == PLAIN
    assert colour_at(image, (2.1, -0.7)) == PLAIN
    assert colour_at(image, (0.5, 0.0)) == START and colour_at(image, (3.5, 0.0)) == GOAL
    assert colour_at(image, (1.5, -0.4)) == colour_at(image, (2.3, 0.3)) == FLOOR


def test_a_disc_covers_as_many_pixels_as_it_has_area():
    image = picture(Ball((1.5, 0.1), 0.4), height=400, dots=False)
    blue = (np.array(FLOOR, float) - image)[..., 0].sum() / (FLOOR[0] - PLAIN[0])
    assert blue * (2 / 400) ** 2 == pytest.approx(np.pi * 0.4**2, rel=2e-3)


@pytest.mark.parametrize("name", OBJECTS)
def test_every_object_is_drawn_on_a_plate_within_its_disc(name):
    image = picture(Ball((2.0, 0.0), 0.5, object=name), height=200, dots=False)
    assert any(colour_at(image, (2.0 + dx, dy)) == PLATE for dx, dy in ((0.47, 0), (-0.47, 0), (0, 0.47), (0, -0.47)))
    assert len({colour_at(image, (2 + x, y)) for x in (-0.2, 0, 0.2) for y in (-0.2, 0, 0.2)} - {PLATE}) >= 1
    rows, columns = np.nonzero((image != np.array(FLOOR)).any(-1))
    place = np.stack([(columns + 0.5) / 400 * 4 - 2.0, 1 - (rows + 0.5) / 200 * 2])
    assert np.hypot(*place).max() < 0.5 + 0.02


def test_objects_can_be_told_apart_even_in_a_small_picture():
    small = {n: picture(Ball((2.0, 0.0), 0.3, object=n), height=24, dots=False).astype(float) for n in OBJECTS}
    for a in small:
        for b in small:
            assert a == b or np.abs(small[a] - small[b]).max() > 40


def test_a_landmark_looks_as_an_obstacle_of_its_kind_does():
    seen = picture(landmarks=(Landmark("burger", (2.0, 0.0), 0.4),))
    assert np.array_equal(seen, picture(Ball((2.0, 0.0), 0.4, object="burger")))


def test_a_small_picture_is_the_large_one_seen_from_afar():
    things = (Ball((1.5, 0.4), 0.3, object="cup"), Block((2.0, -0.8), (2.6, -0.3)))
    large = picture(*things, height=240).astype(float).reshape(40, 6, 80, 6, 3).mean((1, 3))
    assert np.abs(large - picture(*things, height=40)).mean() < 1.5


def test_beyond_the_workspace_the_picture_has_margins():
    image = picture(frame=Frame.of(ROOM), height=80)
    assert image.shape == (80, 80, 3)
    assert tuple(image[5, 40]) == OUTSIDE and tuple(image[75, 40]) == OUTSIDE and tuple(image[40, 40]) == FLOOR


def test_a_frame_goes_there_and_back():
    frame = Frame.of(ROOM, y=(-1.0, 0.0))
    places = np.random.default_rng(0).uniform([0, -1], [4, 1], size=(20, 2))
    np.testing.assert_allclose(frame.to_workspace(frame.to_image(places)), places, atol=1e-12)
    np.testing.assert_allclose(frame.to_image(np.array([[0, -1], [4, 1], [2, 0]])), [[-1, -1], [1, 0], [0, -0.5]])
    assert frame.aspect == 2 and frame.scale == 2


def test_a_frame_needs_a_bounded_plane():
    with pytest.raises(ConfigError, match="only a bounded two-dimensional workspace can be drawn"):
        Frame.of(Box(torch.zeros(3), torch.ones(3)))


def test_a_png_file_holds_the_picture_and_equal_pictures_equal_bytes():
    image = picture(Ball((1.5, 0.4), 0.3, object="pizza"))
    data = png_bytes(image)
    assert np.array_equal(np.rint(imread(io.BytesIO(data))[..., :3] * 255).astype(np.uint8), image)
    assert data == png_bytes(picture(Ball((1.5, 0.4), 0.3, object="pizza")))


def test_the_table_has_food_to_avoid_and_a_burger_that_is_no_obstacle():
    scene = scene_from_mapping(load_scene("table"), state_dim=3, position_dim=2)
    (burger,) = scene.landmarks
    assert burger.object == "burger" and "burger" not in {o.object for o in scene.obstacles}
    assert float(scene.signed_distance(torch.tensor(burger.center, dtype=torch.float64))) > 0.2
    assert "burger" not in scene.constraint_names


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"landmarks": 3}, "scene.landmarks must be a list, found 3"),
        ({"landmarks": [{"center": [0, 0], "radius": 1}]}, "scene.landmarks[0]: key 'object' is missing"),
        (
            {"landmarks": [{"object": "burgr", "center": [0, 0], "radius": 1}]},
            "scene.landmarks[0].object: nothing is drawn as 'burgr' (did you mean 'burger'?); known: burger, apple",
        ),
        (
            {"landmarks": [{"object": "cup", "center": [0, 0], "radius": 0}]},
            "scene.landmarks[0].radius must be a positive number, found 0",
        ),
        (
            {"obstacles": [{"kind": "ball", "object": "car", "center": [0, 0], "radius": 1}]},
            "scene.obstacles[0].object: nothing is drawn as 'car'",
        ),
    ],
)
def test_a_wrong_landmark_or_object_is_named(change, message):
    data = load_scene("table") | change
    with pytest.raises(ConfigError, match=re.escape(message)):
        scene_from_mapping(data, state_dim=3, position_dim=2)
