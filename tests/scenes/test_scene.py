"""Obstacles, workspace and goal: distances against exact arithmetic, and what a wrong scene file gets."""

from __future__ import annotations

import math
import re
from fractions import Fraction
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sagemp_cli.config.folders import load_scene, resource_folder
from sagemp_cli.errors import ConfigError
from sagemp_cli.scenes import Ball, Block, scene_from_mapping
from sagemp_cli.sets import Box

NUMBERS = st.floats(-8, 8)
WIDTHS = st.floats(0, 3)


def box(lower, upper):
    return Box(torch.tensor(lower, dtype=torch.float64), torch.tensor(upper, dtype=torch.float64))


def exact_square_distance(point, lower, upper):
    """Squared distance of a point to a box, in rational arithmetic."""
    gaps = [
        max(Fraction(a) - Fraction(p), Fraction(p) - Fraction(b), Fraction(0)) for p, a, b in zip(point, lower, upper)
    ]
    return sum(g * g for g in gaps)


@given(
    center=st.tuples(NUMBERS, NUMBERS),
    low=st.tuples(NUMBERS, NUMBERS),
    size=st.tuples(WIDTHS, WIDTHS),
    radius=st.floats(0.01, 4),
)
def test_a_balls_clearance_is_a_lower_bound_and_a_tight_one(center, low, size, radius):
    high = tuple(a + w for a, w in zip(low, size))
    found = float(Ball(center, radius).clearance(box(low, high)))
    square = exact_square_distance(center, low, high)
    reach = Fraction(found) + Fraction(radius)  # claimed: distance >= reach
    assert reach <= 0 or reach * reach <= square
    assert found >= math.sqrt(float(square)) - radius - 1e-12


def test_a_ball_that_touches_a_box_is_not_clear_of_it():
    assert float(Ball((0.0, 0.0), 5.0).clearance(box([3.0, 4.0], [6.0, 6.0]))) <= 0
    assert float(Ball((0.0, 0.0), 4.999).clearance(box([3.0, 4.0], [6.0, 6.0]))) == pytest.approx(0.001)


@given(low=st.tuples(NUMBERS, NUMBERS), size=st.tuples(WIDTHS, WIDTHS))
def test_a_blocks_clearance_is_a_lower_bound(low, size):
    high = tuple(a + w for a, w in zip(low, size))
    found = Fraction(float(Block((-1.0, -1.0), (1.0, 1.0)).clearance(box(low, high))))
    gaps = [max(Fraction(a) - 1, -1 - Fraction(b)) for a, b in zip(low, high)]
    assert found <= max(gaps)
    assert found >= max(gaps) - Fraction(1, 10**12)


@pytest.mark.parametrize("obstacle", [Ball((0.5, -0.2), 0.7), Block((-0.2, -0.9), (1.2, 0.5))])
def test_signed_distance_is_negative_exactly_inside_and_has_slope_one(obstacle):
    p = torch.rand(2000, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 4 - 2
    p.requires_grad_()
    distance = obstacle.signed_distance(p)
    inside = (
        (p - torch.tensor(obstacle.center)).norm(dim=-1) < obstacle.radius
        if isinstance(obstacle, Ball)
        else ((torch.tensor(obstacle.lower) < p) & (p < torch.tensor(obstacle.upper))).all(-1)
    )
    assert torch.equal(distance < 0, inside)
    (slope,) = torch.autograd.grad(distance.sum(), p)
    assert torch.allclose(slope.norm(dim=-1), torch.ones(len(p), dtype=torch.float64))


def toy():
    return {
        "workspace": {"lower": [-1, -1], "upper": [3, 3]},
        "obstacles": [
            {"kind": "ball", "center": [1, 1], "radius": 0.5, "name": "disc"},
            {"kind": "block", "lower": [2, 0], "upper": [2.5, 1]},
        ],
        "goal": {"lower": [2, 2, "-inf"], "upper": [3, 3, "inf"]},
    }


def test_clearances_are_those_of_the_workspace_and_every_obstacle_in_order():
    scene = scene_from_mapping(toy(), state_dim=3, position_dim=2)
    assert scene.constraint_names == ("workspace", "disc", "obstacle 1")
    found = scene.clearances(box([[0.0, 0.0], [-2.0, 0.0]], [[0.5, 0.5], [-1.5, 0.5]]))
    assert found.shape == (2, 3)
    assert found[0].tolist() == pytest.approx([1.0, math.sqrt(0.5) - 0.5, 1.5])
    assert float(found[1, 0]) == pytest.approx(-1.0)


def test_the_signed_distance_of_a_scene_is_that_of_its_nearest_constraint():
    scene = scene_from_mapping(toy(), state_dim=3, position_dim=2)
    p = torch.tensor([[-0.9, 2.0], [1.0, 1.0], [4.0, 2.0]], dtype=torch.float64)
    assert scene.signed_distance(p).tolist() == pytest.approx([0.1, -0.5, -1.0])


def test_a_goal_may_leave_states_open():
    goal = scene_from_mapping(toy(), state_dim=3, position_dim=2).goal
    assert bool(goal.contains(torch.tensor([2.5, 2.5, 1e9], dtype=torch.float64)))


def changed(path, value):
    def change(data):
        node = data
        for key in path[:-1]:
            node = node[key]
        node[path[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("goal"), "scene: key 'goal' is missing"),
        (changed(["goals"], {}), "scene: unknown key 'goals' (did you mean 'goal'?)"),
        (changed(["goal"], 3), "scene.goal must be a mapping with lower, upper, found 3"),
        (changed(["goal", "lower"], [1, 2]), "scene.goal.lower needs 3 numbers, found 2"),
        (changed(["goal", "lower"], "far"), "scene.goal.lower must be a list of numbers, found 'far'"),
        (changed(["goal", "uper"], [1]), "scene.goal: unknown key 'uper' (did you mean 'upper'?)"),
        (changed(["workspace", "lower"], [5, -1]), "scene.workspace: lower must not exceed upper, found [5.0, -1.0]"),
        (changed(["workspace", "lower"], [float("nan"), 0]), "scene.workspace.lower contains NaN"),
        (changed(["obstacles"], "none"), "scene.obstacles must be a list, found 'none'"),
        (changed(["obstacles", 0], 4), "scene.obstacles[0].kind must be 'ball' or 'block', found None"),
        (changed(["obstacles", 0, "kind"], "cone"), "scene.obstacles[0].kind must be 'ball' or 'block', found 'cone'"),
        (changed(["obstacles", 0, "radius"], -1), "scene.obstacles[0].radius must be a positive number, found -1"),
        (changed(["obstacles", 0, "radius"], "wide"), "scene.obstacles[0].radius must be a list of numbers"),
        (changed(["obstacles", 0, "radius"], float("inf")), "scene.obstacles[0].radius must be finite"),
        (changed(["obstacles", 0, "colour"], "red"), "scene.obstacles[0]: unknown key 'colour'; known: "),
        (changed(["obstacles", 0, "center"], [0]), "scene.obstacles[0].center needs 2 numbers, found 1"),
        (changed(["obstacles", 1, "lower"], [3, 0]), "scene.obstacles[1]: lower must lie below upper"),
    ],
)
def test_a_wrong_scene_is_refused_by_the_name_of_the_key(change, message):
    data = toy()
    change(data)
    with pytest.raises(ConfigError, match=re.escape(message)):
        scene_from_mapping(data, state_dim=3, position_dim=2)


@pytest.mark.parametrize("path", sorted((resource_folder("data") / "scenes").glob("*.yaml")), ids=lambda p: p.stem)
def test_every_scene_file_is_a_scene_that_its_readme_lists(path):
    data = load_scene(path.stem)
    dims = len(data["workspace"]["lower"])
    scene_from_mapping(data, state_dim=len(data["goal"]["lower"]), position_dim=dims)
    assert f"| `{path.stem}` |" in (Path(path).parent / "README.md").read_text(encoding="utf-8")


def test_an_obstacle_occupies_a_box_only_if_it_holds_every_corner():
    ball, block = Ball((0.0, 0.0), 1.0), Block((-1.0, -1.0), (1.0, 1.0))
    inside, out = Box.around([0.0, 0.0], [0.7, 0.7]), Box.around([0.0, 0.0], [0.71, 0.71])
    assert bool(ball.occupies(inside)) and not bool(ball.occupies(out))
    assert bool(block.occupies(out)) and not bool(block.occupies(Box.around([0.5, 0.0], [0.51, 0.1])))
    touching = Box(torch.tensor([1.0, 0.0]), torch.tensor([1.0, 0.0]))
    assert bool(block.occupies(touching))
    assert not bool(ball.occupies(Box.around([0.6, 0.8], [0.0, 0.0])))  # on the surface: rounding decides nothing
