"""Requirements of loops in continuous time reduce to margins that must not be negative, and when."""

import math

import pytest
import torch

from sagemp_cli.errors import UsageError
from sagemp_cli.scenes.requirements import Holds, Inside, Outside, of_scene
from sagemp_cli.scenes.scene import Ball, Block, Scene
from sagemp_cli.sets import Box

NAMES = ("a", "b", "c")


def keeps(requirement, *states):
    formula = requirement.formula(NAMES)
    margins = formula.margins(torch.tensor(states, dtype=torch.float64))
    held = formula.holds(margins)
    return (held.all(-1) if formula.every else held.any(-1)).tolist()


def test_inside_is_closed_and_leaves_other_states_free():
    box = Inside({"a": (0.0, 1.0), 2: (-math.inf, 5.0)})
    assert keeps(box, (0.0, 99.0, 5.0), (1.0, -99.0, -1e9), (1.1, 0.0, 0.0), (0.5, 0.0, 5.1)) == [
        True,
        True,
        False,
        False,
    ]


def test_outside_keeps_off_the_faces_and_needs_one_state_to_be_out():
    box = Outside({"a": (0.0, 1.0), "b": (0.0, 1.0)})
    assert keeps(box, (0.5, 0.5, 0.0), (1.0, 0.5, 0.0), (1.1, 0.5, 0.0), (0.5, -0.1, 0.0)) == [False, False, True, True]


def test_a_margin_that_is_not_a_number_holds_nothing():
    nothing = torch.tensor(math.nan)
    for requirement in (Inside({"a": (0.0, 1.0)}), Outside({"a": (0.0, 1.0)}), Holds(lambda x: x)):
        assert not bool(requirement.formula(NAMES).holds(nothing))


@pytest.mark.parametrize(
    ("requirement", "says"),
    [
        (Inside({"d": (0.0, 1.0)}), "speaks of state 'd', which the loop does not have"),
        (Inside({3: (0.0, 1.0)}), "speaks of state 3, which the loop does not have; known: a, b, c"),
        (Outside({"a": (1.0, 0.0)}), "state a needs a least and a greatest value"),
        (Inside({"a": (math.nan, 0.0)}), "state a needs a least and a greatest value"),
        (Inside({"a": 3}), "state a needs two numbers, found 3"),
        (Inside({}), "bounds no state"),
        (Inside({"a": (0.0, 1.0)}, when="soon"), "when is 'always', 'end' or two times, found 'soon'"),
        (Inside({"a": (0.0, 1.0)}, when=(2.0, 1.0)), "when needs a time of at least 0 and a later one"),
        (Holds(lambda x: x, when=(math.nan, 1.0)), "when needs a time of at least 0 and a later one"),
    ],
)
def test_what_cannot_be_required_is_refused_in_one_line(requirement, says):
    with pytest.raises(UsageError, match=says.replace("(", r"\(")) as error:
        requirement.formula(NAMES)
    assert "\n" not in str(error.value)


def test_a_scenes_faces_are_required_as_they_are():
    """Not as float32 rounds them: an obstacle would be smaller than it is."""
    low, high = (0.1, 1000.1), (0.3, 1000.7)
    box = Box(*(torch.tensor(side, dtype=torch.float64) for side in (low, high)))
    for required in of_scene(Scene(box, (Block(low, high, "wall"),), box), (0, 1)):
        assert required.bounds == {0: (0.1, 0.3), 1: (1000.1, 1000.7)}


def test_a_scene_is_requirements():
    ends = [torch.tensor([s * 5.0, s * 5.0], dtype=torch.float64) for s in (-1, 1)]
    goal = Box(torch.tensor([1.0, -math.inf, -math.inf]), torch.tensor([2.0, math.inf, math.inf]))
    scene = Scene(Box(*ends), (Ball((0.0, 0.0), 1.0, "tree"), Block((2.0, 2.0), (3.0, 3.0), "wall")), goal)
    workspace, tree, wall, end = of_scene(scene, (0, 1))
    assert [r.name for r in (workspace, tree, wall, end)] == ["workspace", "tree", "wall", "goal"]
    assert keeps(workspace, (4.0, 4.0, 99.0), (6.0, 0.0, 0.0)) == [True, False]
    assert keeps(tree, (1.1, 0.0, 0.0), (0.6, 0.6, 0.0), (1.0, 0.0, 0.0)) == [True, False, False]
    assert keeps(wall, (2.5, 2.5, 0.0), (2.5, 1.9, 0.0)) == [False, True]
    assert keeps(end, (1.5, 0.0, 7.0), (0.5, 0.0, 0.0)) == [True, False]
    assert end.when == "end"
    assert (
        of_scene(Scene(Box(*[e * math.inf for e in ends]), (), Box(*[e[[0, 0, 0]] * math.inf for e in ends])), (0, 1))
        == ()
    )
