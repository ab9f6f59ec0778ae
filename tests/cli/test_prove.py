"""``sagemp prove``: any step in torch, from the command line to a certificate that is checked."""

from __future__ import annotations

import json

import pytest
import torch

from sagemp_cli.errors import ConfigError, UsageError
from sagemp_cli.sets import Box
from sagemp_cli.stages.prove import prove
from sagemp_cli.verification.verdict import Answer

LOOP = """
import torch

A = torch.tensor([[0.85, -0.35], [0.35, 0.85]], dtype=torch.float64)

def step(x, w):
    return x @ A.T + 0.1 * torch.sin(x) * w

def turning(k, x, w):
    return x @ (A.T * (1.0 if k % 2 else 0.9)) + torch.tanh(x) * w

def alone(x):
    return x @ A.T

def explodes(x):
    return 30.0 * x * x

def wrong(x, w):
    return x @ torch.eye(3)
"""
SCENE = """
workspace: {lower: [-1.5, -1.5], upper: [1.5, 1.5]}
obstacles:
  - {kind: ball, name: pillar, center: [0.3, -0.9], radius: 0.3}
  - {kind: block, name: wall, lower: [-1.4, 0.9], upper: [-0.8, 1.4]}
goal: {lower: [-0.4, -.inf], upper: [0.4, .inf]}
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a loop and a scene, which is the working directory."""
    name = f"loop_{abs(hash(str(tmp_path))) % 10**8}"  # modules are imported once in a process
    (tmp_path / f"{name}.py").write_text(LOOP)
    (tmp_path / "scene.yaml").write_text(SCENE)
    monkeypatch.chdir(tmp_path)
    return name


START, W = "0.9:1.1,-0.1:0.1", "-0.1:0.1,-0.1:0.1"


def test_a_loop_of_ones_own_is_certified_and_the_file_is_checked_without_its_code(sagemp, folder, tmp_path):
    said = sagemp(
        "prove", f"{folder}.py:step", "--start", START, "--disturbance", W, "--horizon", "12", "--scene", "scene.yaml",
        "--names", "a,b", "--units", "m,m", "--dt", "0.1", "--output", "out.h5",
    )  # fmt: skip
    assert said.exit_code == 0 and said.stdout.startswith("VERIFIED: SAFE (K = 12, 1 cell, affine)")
    assert "from pillar" in said.stdout and "from wall" in said.stdout and (tmp_path / "out.png").stat().st_size > 10000
    (tmp_path / f"{folder}.py").unlink()
    checked = sagemp("check", "out.h5")
    assert checked.exit_code == 0
    assert "clear of 2 obstacles, x_K is in the goal" in checked.stdout and "a 0.9 to 1.1 m" in checked.stdout


def test_a_loop_that_breaks_its_claim_is_refuted_and_the_counterexample_is_checked(sagemp, folder):
    said = sagemp("prove", f"{folder}.py:alone", "--start", START, "--horizon", "5", "--goal", "0.6:,:")
    assert said.exit_code == 10 and "FALSIFIED: UNSAFE at step 5 (goal x0)" in said.stdout
    assert "counterexample: from (" in said.stdout
    assert sagemp("check", f"{folder}_alone.h5").exit_code == 10


PIN = "obstacles: [{kind: ball, name: pin, center: [0.75, 0.75], radius: 0.01}]"


def test_an_obstacle_between_two_samples_counts_unless_the_samples_alone_are_asked_for(sagemp, folder, tmp_path):
    (tmp_path / f"{folder}.py").write_text("def ahead(x):\n    return x + 0.5 + 0.001 * x.sin()\n")
    (tmp_path / "pin.yaml").write_text(PIN)
    given = ("prove", f"{folder}.py:ahead", "--start", "0:0.01,0:0.01", "--horizon", "3", "--scene", "pin.yaml")
    said = sagemp(*given, "--output", "lines.h5")
    assert said.exit_code == 10 and "FALSIFIED: UNSAFE at step 1.4" in said.stdout
    assert sagemp("check", "lines.h5").exit_code == 10
    said = sagemp(*given, "--output", "samples.h5", "--between", "samples")
    assert said.exit_code == 0 and "from pin at the samples only" in said.stdout
    assert "between the samples nothing is claimed" in said.stdout
    checked = sagemp("check", "samples.h5")
    assert checked.exit_code == 0 and "of the time between them NOTHING is claimed" in checked.stdout
    wrong = sagemp(*given, "--output", "no.h5", "--between", "never")
    assert wrong.exit_code == 2 and "between must be 'segments' or 'samples', found 'never'" in wrong.stderr


def test_without_scene_and_goal_the_tube_is_proved(sagemp, folder):
    said = sagemp("prove", f"{folder}.py:step", "--start", START, "--disturbance", W, "--horizon", "6", "--json")
    data = json.loads(said.stdout)
    assert said.exit_code == 0 and data["verdict"] == "VERIFIED" and not data["asks"] and data["clearance"] == {}
    assert sagemp("check", data["certificate"]).exit_code == 0
    unknown = sagemp("prove", f"{folder}.py:explodes", "--start", START, "--horizon", "40", "--partitions", "1")
    assert unknown.exit_code == 5 and "UNKNOWN: UNBOUNDED" in unknown.stdout and "unbounded: " in unknown.stdout
    assert sagemp("check", f"{folder}_explodes.h5").exit_code == 5


def test_a_step_that_depends_on_its_number_is_certified_and_checked(sagemp, folder):
    said = sagemp(
        "prove", f"{folder}.py:turning", "--start", START, "--disturbance", W, "--horizon", "4", "--goal", ":,:1.2"
    )
    assert said.exit_code == 0
    assert sagemp("check", f"{folder}_turning.h5").exit_code == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{}.py:stpe", "--start", START, "--horizon", "5"], "defines no 'stpe' (did you mean 'step'?)"),
        (["{}.py", "--start", START, "--horizon", "5"], "such as my_loop.py:step"),
        (["nowhere.py:step", "--start", START, "--horizon", "5"], "no such file"),
        (["{}.py:step", "--start", "1.1:0.9,0", "--horizon", "5"], "--start: '1.1:0.9' must be lower:upper"),
        (["{}.py:step", "--start", "a,0", "--horizon", "5"], "--start: 'a' is no number and no interval"),
        (["{}.py:step", "--start", START], "horizon must be a positive integer, found None"),
        (["{}.py:wrong", "--start", START, "--horizon", "5"], "shapes cannot be multiplied"),
        (["{}.py:step", "--start", START, "--horizon", "5", "--scene", "no.yaml"], "no.yaml: no such file"),
        (["{}.py:step", "--start", START, "--horizon", "5", "--names", "a"], "2 states need 2 words, found 1"),
        (
            ["{}.py:step", "--start", START, "--horizon", "5", "--goal", "0:1"],
            "goal.lower needs 2 numbers, found 1",
        ),
        (
            ["{}.py:step", "--start", START, "--horizon", "5", "--scene", "scene.yaml", "--position", "x7,x0"],
            "position: no state 'x7'; known: x0, x1, or 0 to 1",
        ),
        (["{}.py:step", "--start", START, "--horizon", "5", "--partitions", "4x"], "partitions must be"),
        (["{}.py:step", "--start", START, "--horizon", "5", "--propagator", "afine"], "did you mean 'affine'?"),
    ],
)
def test_what_is_wrong_is_one_line_and_nothing_is_written(sagemp, folder, tmp_path, arguments, message):
    before = sorted(p.name for p in tmp_path.iterdir())
    said = sagemp("prove", *(a.format(folder) for a in arguments))
    assert said.exit_code == 2
    assert message in " ".join(said.stderr.split()) and len(said.stderr.strip().splitlines()) == 1
    assert sorted(p.name for p in tmp_path.iterdir() if p.name != "__pycache__") == before


def test_a_file_that_is_there_is_not_replaced_unasked(sagemp, folder, tmp_path):
    call = ["prove", f"{folder}.py:alone", "--start", START, "--horizon", "3", "--output", "out.h5"]
    assert sagemp(*call).exit_code == 0
    before = (tmp_path / "out.h5").read_bytes()
    refused = sagemp(*call)
    assert refused.exit_code == 2 and "out.h5: exists already" in refused.stderr
    assert (tmp_path / "out.h5").read_bytes() == before
    assert sagemp(*call, "--overwrite").exit_code == 0


def test_one_call_in_python_gives_verdict_tube_and_files(tmp_path):
    def step(x, w):
        return 0.8 * x + torch.stack([w[..., 0], 0.0 * w[..., 0]], -1)

    start, w = Box(torch.tensor([0.9, 0.0]), torch.tensor([1.0, 0.1])), Box(torch.tensor([-0.1]), torch.tensor([0.1]))
    goal = Box(torch.tensor([-1.0, -1.0]), torch.tensor([1.0, 1.0]))
    proof = prove(step, start, w, 6, goal=goal, certificate=tmp_path / "out.h5")
    assert proof.answer is Answer.VERIFIED and proof.tube.lower.shape == (7, 2)
    assert (tmp_path / "out.h5").is_file() and (tmp_path / "out.png").is_file()
    assert prove(step, start, w, 6, scene={"workspace": {"lower": [0.95], "upper": [2.0]}}).answer is Answer.FALSIFIED


def test_scenes_that_say_what_cannot_be_are_refused():
    start = Box(torch.zeros(2), torch.ones(2))

    def ask(**options):
        return prove(lambda x: 0.5 * x, start, None, 2, **options)

    with pytest.raises(UsageError, match="unknown key 'wrokspace'.*did you mean 'workspace'"):
        ask(scene={"wrokspace": {}})
    with pytest.raises(UsageError, match="the scene has a goal, and another one"):
        ask(scene={"goal": {"lower": [0, 0], "upper": [1, 1]}}, goal=start)
    with pytest.raises(UsageError, match="the scene is about 1 states, position names 2"):
        ask(scene={"workspace": {"lower": [0.0], "upper": [1.0]}}, position=[0, 1])
    with pytest.raises(ConfigError, match="must not exceed upper"):
        ask(scene={"workspace": {"lower": [2.0], "upper": [1.0]}})
    with pytest.raises(UsageError, match="must be different words"):
        ask(state_names=["a", "a"])
    with pytest.raises(UsageError, match="dt must be a positive number"):
        ask(dt=-1.0)
