"""What is made of a model's answer: every way in which it can be wrong is one line that says so."""

from __future__ import annotations

import json
import re
import sys
import time

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sagemp_cli.planners.vlm import AnswerError, waypoints_of
from sagemp_cli.scenes import Frame
from sagemp_cli.sets import Box

FRAME = Frame.of(Box(torch.tensor([-2.0, -2.0]), torch.tensor([2.0, 2.0])))
WIDE = Frame.of(Box(torch.tensor([-2.0, -1.0]), torch.tensor([2.0, 1.0])))


@pytest.mark.parametrize(
    "answer",
    [
        '{"waypoints": [[0.1, -0.2], [0.5, 1]]}',
        'Sure! Here is [a path]: {"waypoints": [[0.1, -0.2], [0.5, 1]]} Drive safely {or not}.',
        '```json\n{"waypoints": [[0.1, -0.2], [0.5, 1]]}\n```',
        '{"reasoning": "around the cup", "waypoints": [[0.1, -0.2], [0.5, 1]], "cost": [1, 2]}',
        '{"path": [{"x": 0.1, "y": -0.2}, {"x": 0.5, "y": 1}]}',
        "[[0.1, -0.2], [0.5, 1]]",
        'First I thought {"plan": "left"}, then {"waypoints": [[0.1, -0.2], [0.5, 1]]}',
    ],
)
def test_waypoints_are_found_in_every_reasonable_form(answer):
    assert waypoints_of(answer, FRAME).tolist() == [[0.1, -0.2], [0.5, 1.0]]


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ("", "the answer is empty"),
        ("  \n ", "the answer is empty"),
        ("x" * 100_001, "the answer has 100001 characters, 100000 are looked at at most"),
        ("I'm sorry, but I can't help with that.", "the model refuses: 'I'm sorry, but I can't help with that.'"),
        ("Go left at the cup.", "the answer holds no JSON object, found 'Go left at the cup.'"),
        ('{"waypoints": [[0.1, 0.2], [0.3', "the answer's JSON is broken or cut off, found"),
        ("[" * 50_000, "the answer's JSON is nested too deep"),
        ('{"route": "left"}', "the answer's JSON has no list of waypoints, found keys '['route']'"),
        ('{"waypoints": "left"}', "waypoints must be a list of [x, y], found 'left'"),
        ('{"waypoints": []}', "the answer lists no waypoints, at least 1 is needed"),
        (json.dumps({"waypoints": [[0, 0]] * 101}), "the answer lists 101 waypoints, at most 100 are allowed"),
        ('{"waypoints": [[0, 0], [1]]}', "waypoints[1] must be two numbers [x, y], found '(1,)'"),
        ('{"waypoints": [[0, 0, 0]]}', "waypoints[0] must be two numbers [x, y], found '(0, 0, 0)'"),
        ('{"waypoints": [3]}', "waypoints[0] must be two numbers [x, y], found '3'"),
        ('{"waypoints": [["0.1", 0]]}', "waypoints[0][0] must be a finite number, found '0.1'"),
        ('{"waypoints": [[0, true]]}', "waypoints[0][1] must be a finite number, found 'True'"),
        ('{"waypoints": [[0, null]]}', "waypoints[0][1] must be a finite number, found 'None'"),
        ('{"waypoints": [[NaN, 0]]}', "waypoints[0][0] must be a finite number, found 'nan'"),
        ('{"waypoints": [[0, -1e999]]}', "waypoints[0][1] must be a finite number, found '-inf'"),
        ('{"waypoints": [[0, 0], [0, 1.01]]}', "waypoints[1] lies outside the image [-1, 1] x [-1, 1], found"),
    ],
)
def test_an_answer_that_is_no_use_is_refused_in_one_line(answer, message):
    with pytest.raises(AnswerError, match=re.escape(message)) as caught:
        waypoints_of(answer, FRAME)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 250


def test_brackets_without_end_are_refused_at_once_whatever_the_recursion_limit():
    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(200_000)
    try:
        with pytest.raises(AnswerError, match="nested too deep"):
            waypoints_of("[" * 50_000, FRAME)
    finally:
        sys.setrecursionlimit(limit)


def test_brackets_that_only_seem_to_be_closed_are_refused_whatever_the_recursion_limit():
    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(200_000)
    try:
        with pytest.raises(AnswerError, match="nested too deep"):
            waypoints_of('["]",' * 19_000, FRAME)
    finally:
        sys.setrecursionlimit(limit)


@pytest.mark.parametrize(
    "answer",
    [
        "[" * 99 + "[]," * 33_000,
        '[" ' * 30 + "[]" * 30_000,
        '[ "' + '\\"' * 49_000,
        '{"a":' * 50 + '"\\"' * 30_000,
        "[}" * 49_000,
        "[1," * 90 + "1," * 45_000,
        '{"waypoints": [' + "[0.1,0.2]," * 9_000,
        '{"waypoints": [' + "[null,0]," * 11_000 + "[0,0]]}",
        "[" + "9" * 90_000 + "]",
        '{"waypoints": [[' + "9" * 4_000 + ", 0]]}",
    ],
)
def test_an_answer_made_to_be_slow_is_refused_within_moments(answer):
    assert len(answer) <= 100_000
    began = time.perf_counter()
    with pytest.raises(AnswerError) as caught:
        waypoints_of(answer, FRAME)
    assert time.perf_counter() - began < 15  # at most 0.8 s on an idle core
    assert str(caught.value).isprintable() and len(str(caught.value)) < 250


@pytest.mark.parametrize(
    "answer", ["I cannot \x1b]0;x\x07", '{"\x1b[2J": 1}', '{"waypoints": "\x9b31m\u202e"}', "\ud800"]
)
def test_what_a_terminal_would_obey_is_never_in_a_message(answer):
    with pytest.raises(AnswerError) as caught:
        waypoints_of(answer, FRAME)
    assert str(caught.value).isprintable()


def test_a_place_in_the_image_but_outside_the_workspace_is_refused():
    with pytest.raises(AnswerError, match=re.escape("outside the workspace [-1, 1] x [-0.5, 0.5], found '[0.0, 0.6]'")):
        waypoints_of('{"waypoints": [[0, 0.6]]}', WIDE)
    assert waypoints_of('{"waypoints": [[0, 0.5]]}', WIDE).tolist() == [[0.0, 0.5]]


def test_how_many_are_too_many_can_be_chosen():
    with pytest.raises(AnswerError, match="lists 3 waypoints, at most 2 are allowed"):
        waypoints_of('{"waypoints": [[0, 0], [0, 0], [0, 0]]}', FRAME, most=2)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(["waypoints", "x", "y", "a"]), inner),
    max_leaves=6,
)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(JSON.map(json.dumps) | st.text(alphabet='{}[]"waypoints:,.0123eE- \n'))
def test_whatever_is_answered_gives_finite_places_in_the_image_or_one_line(answer):
    try:
        found = waypoints_of(answer, FRAME)
    except AnswerError as e:
        assert "\n" not in str(e)
    else:
        assert found.ndim == 2 and found.shape[1] == 2 and len(found) > 0 and abs(found).max() <= 1 + 1e-6
