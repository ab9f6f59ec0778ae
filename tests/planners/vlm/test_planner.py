"""The planner around its providers: options, recorded answers, and the stand-in that teaches itself."""

from __future__ import annotations

import json
import os
import re

import numpy as np
import pytest
import torch

from sagemp_cli.config.binding import build
from sagemp_cli.config.composition import compose
from sagemp_cli.errors import ConfigError, UsageError
from sagemp_cli.planners.vlm import VLM
from sagemp_cli.planners.vlm.network import ReaderOptions
from sagemp_cli.planners.vlm.planner import PracticeOptions
from sagemp_cli.sets import Box

START = torch.tensor([-1.5, -0.2, 0.0], dtype=torch.float64)
SIZES = {"state_dim": 3, "horizon": 30, "dt": 0.3}
TOY = PracticeOptions(steps=6, exercises=24, held_out=8, batch=8)


def draw(planner, scene, count=3, *, seed=0, start=START):
    generator = torch.Generator().manual_seed(seed)
    return planner.sample(start, scene.goal, scene=scene, count=count, generator=generator)


@pytest.fixture
def recording(tmp_path):
    path = tmp_path / "answers.json"
    texts = [json.dumps({"waypoints": [[0.0, y]]}) for y in (-0.6, 0.9)]
    path.write_text(json.dumps({"answers": texts}))
    return path


def test_replay_draws_from_the_recorded_answers(recording, table):
    planner = VLM(**SIZES, provider="replay", recording=str(recording))
    found = draw(planner, table, count=12)
    heights = {round(float(y), 1) for y in found[:, 15, 1]}
    assert found.shape == (12, 31, 3) and len(heights) == 2
    assert torch.equal(found, draw(planner, table, count=12))
    assert planner.label == "VLM planner, replay of answers.json" and planner.learns_from == "nothing"


def test_every_reference_begins_at_its_own_start(recording, table):
    planner = VLM(**SIZES, provider="replay", recording=str(recording))
    starts = START + torch.tensor([[0.0, 0.0, 0.0], [0.05, -0.05, 0.1]])
    assert torch.equal(draw(planner, table, count=2, start=starts)[:, 0], starts)


def test_a_four_state_robot_gets_speeds(recording, table):
    planner = VLM(state_dim=4, horizon=30, dt=0.3, provider="replay", recording=str(recording))
    start, goal = torch.tensor([-1.5, -0.2, 0.0, 0.4]).double(), Box(*(torch.cat([b, b[:1]]) for b in _corners(table)))
    found = planner.sample(start, goal, scene=table, count=1, generator=torch.Generator())
    assert found.shape == (1, 31, 4) and torch.equal(found[0, 0], start)
    assert float(found[0, 1:, 3].std()) < 0.05


def _corners(scene):
    return scene.goal.lower, scene.goal.upper


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "a recording must be JSON"),
        ('{"answers": []}', 'a recording must hold {"answers": [text, ...]} with at least one text'),
        ('{"answers": [3]}', 'a recording must hold {"answers": [text, ...]} with at least one text'),
        ("[" * 100_000, "a recording must be JSON"),
        ("\xff", "a recording must be JSON"),
        ("[]", "a recording must hold"),
        ('{"answers": ["a"], "modle": "m"}', "and may hold model, date (2026-11-28) and prompt_hash"),
        ('{"answers": ["a"], "model": "\\u001b[31m"}', "a recording must hold"),
        ('{"answers": ["a"], "model": "$\\\\frac$"}', "a recording must hold"),
        ('{"answers": ["a"], "date": "yesterday"}', "a recording must hold"),
        ('{"answers": ["a"], "prompt_hash": "0"}', "a recording must hold"),
    ],
)
def test_a_recording_that_is_none_is_named(tmp_path, table, content, message):
    path = tmp_path / "answers.json"
    path.write_text(content, encoding="latin-1")
    with pytest.raises(UsageError, match=re.escape(f"{path}: ")) as caught:
        draw(VLM(**SIZES, provider="replay", recording=str(path)), table)
    assert message in str(caught.value) and str(caught.value).isprintable()


def test_a_pipe_a_huge_file_and_an_empty_folder_are_no_recordings(tmp_path, table):
    os.mkfifo(tmp_path / "pipe")
    with (tmp_path / "huge").open("wb") as file:
        file.truncate(2**40)
    (tmp_path / "empty").mkdir()
    for name, message in (
        ("pipe", "a recording must be a file of at most"),
        ("huge", "a recording must be a file of at most"),
        ("empty", "found 0 recordings (*.json)"),
        ("missing", "a recording must be a file of at most"),
    ):
        with pytest.raises(UsageError, match=re.escape(f"{tmp_path / name}: {message}")):
            draw(VLM(**SIZES, provider="replay", recording=str(tmp_path / name)), table)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"provider": "clairvoyant"}, "planner.provider must be one of local, gemini, openai, replay"),
        ({"state_dim": 6}, "fills in heading and speed of a unicycle with 3 or 4 states, found a robot with 6"),
        ({"prompt": "burger"}, "planner.prompt 'burger': no such prompt"),
        ({"provider": "replay"}, "planner.recording is for provider 'replay' and only for it, found None"),
        ({"recording": "a.json"}, "planner.recording is for provider 'replay' and only for it, found 'a.json'"),
        ({"attempts": 0}, "planner.attempts must be a whole number of at least 1, found 0"),
        ({"drive": {"radius": 1.0}}, "planner.drive.radius: Drive has no such option"),
        ({"network": {"pixels": 20}}, "planner.network: pixels must be a multiple of 8"),
    ],
)
def test_wrong_options_are_named(options, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        about = SIZES | {key: value for key, value in options.items() if key in SIZES}
        section = {key: value for key, value in options.items() if key not in SIZES}
        build({"name": "vlm"} | section, "planner", **about)


def test_a_goal_without_a_place_is_refused(table):
    nowhere = Box(torch.full((3,), -torch.inf), torch.full((3,), torch.inf))
    with pytest.raises(ConfigError, match="the goal must be bounded in the position"):
        VLM(**SIZES).sample(START, nowhere, scene=table, count=1, generator=torch.Generator())


def test_a_service_has_nothing_to_learn(table):
    planner = VLM(**SIZES, provider="openai")
    assert planner.learns_from == "nothing" and not list(planner.state_dict()) and planner.affordable_plans == 4
    with pytest.raises(UsageError, match="provider 'openai' has nothing to train; only 'local' learns"):
        planner.learn(TOY, scene=table, generator=torch.Generator())


@pytest.fixture(scope="module")
def taught(table):
    planner = VLM(**SIZES, network=ReaderOptions(pixels=32, channels=8))
    history = planner.learn(TOY, scene=table, generator=torch.Generator().manual_seed(0))
    return planner, history


def test_the_stand_in_says_that_it_is_one(taught):
    planner, history = taught
    assert planner.learns_from == "scenes"
    assert planner.label == "VLM planner, stand-in (small local network), no vision-language model"
    assert set(history.validation) == {
        "collision-free (stand-in, random scenes)",
        "passes over (stand-in, random scenes)",
        "collision-free (stand-in, this scene)",
        "passes over burger (stand-in, this scene)",
    }
    assert all(0 <= v[-1] <= 1 for v in history.validation.values())


def test_learning_again_with_the_same_seed_gives_the_same_bits(taught, table):
    planner, history = taught
    again = VLM(**SIZES, network=ReaderOptions(pixels=32, channels=8))
    other = again.learn(TOY, scene=table, generator=torch.Generator().manual_seed(0))
    np.testing.assert_array_equal(history.loss, other.loss)
    assert all(torch.equal(v, again.state_dict()[k]) for k, v in planner.state_dict().items())


def test_arguments_and_weights_rebuild_the_planner(taught, table):
    planner, _ = taught
    again = build({"name": "vlm"} | json.loads(json.dumps(planner.arguments)), "planner")
    again.load_state_dict(planner.state_dict())
    assert torch.equal(draw(planner, table), draw(again.eval(), table))


def test_the_stand_ins_answers_depend_on_the_generator_only(taught, table):
    planner, _ = taught
    found = draw(planner, table)
    assert found.shape == (3, 31, 3) and bool(torch.isfinite(found).all())
    assert torch.equal(found, draw(planner, table))


def test_the_config_builds_it():
    config = compose(["experiment=unicycle_vlm"])
    planner = build(config["planner"], "planner", state_dim=3, horizon=100, dt=0.1)
    assert isinstance(planner, VLM) and planner.provider_name == "local"
    assert config["sources"]["train-tracker"] == "kinematic_node"
