"""``sagemp init``: a project of somebody else's own robot, from an empty folder to a verdict."""

from __future__ import annotations

import dataclasses
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from sagemp_cli.config.composition import compose
from sagemp_cli.errors import ArtifactError
from sagemp_cli.pipeline.models import planner_from
from sagemp_cli.plugins import registry
from sagemp_cli.storage import Certificate, Header, PlannerModel, read_artifact, write_artifact
from sagemp_cli.verification.executors import processes


@pytest.fixture
def rover(sagemp, monkeypatch):
    """``sagemp(...)`` in the folder of a project ``rover``."""
    monkeypatch.setattr(registry, "_registered", dict(registry._registered))
    monkeypatch.setattr(sys, "path", list(sys.path))
    made = sagemp("init", "rover")
    assert made.exit_code == 0 and "made rover/: " in made.stdout
    monkeypatch.chdir("rover")
    yield sagemp
    sys.modules.pop("rover", None)


def test_the_projects_files_have_the_robots_name(rover):
    files = {str(p) for p in Path().rglob("*") if p.is_file()}
    assert {"rover.py", "README.md", "Makefile", "plan.csv", "test_rover.py", "scenes/room.yaml"} <= files
    assert {f"conf/{group}/rover.yaml" for group in ("dynamics", "tracker", "experiment")} <= files
    text = "".join(Path(f).read_text() for f in files)
    assert "class Rover(Dynamics)" in text and "my_robot" not in text and "MyRobot" not in text


def test_its_config_is_sound_and_its_robot_and_planner_are_options(rover):
    assert "1 config checked, no errors" in rover("config", "validate", "experiment=rover").stdout
    assert "1 config checked, no errors" in rover("config", "validate", "planner=detour", "+planner.widest=0.3").stdout
    listed = rover("config", "list").stdout
    assert "  * rover" in listed and "detour                        a plugin" in listed
    wrong = rover("config", "validate", "dynamics.lagg=3", "+dynamics.lag=fast")
    assert wrong.exit_code == 2


def test_a_plan_of_its_own_goes_all_the_way_to_a_verdict_also_in_worker_processes(rover, monkeypatch):
    """With next to no training: whether it is certified is not asked here, only that the tube is made and stored."""
    short = ("horizon=12", "tracker_training.steps=3", "tracker_training.tube_steps=0", "tracker_training.references=2")
    short += ("tracker_training.rollout_steps=4", "tracker_training.tube=null", "verify.falsifier.restarts=0")
    workers = ("verify.samples=0", "executor.workers=2", "executor.least=1", "proof.memory=0.0025")
    pools, pool = [], processes.ProcessPoolExecutor
    monkeypatch.setattr(processes, "ProcessPoolExecutor", lambda *a, **k: pools.append(a) or pool(*a, **k))
    made = rover("run", "--until", "verify", "planner=detour", *short, *workers)
    assert len(pools) == 1
    assert made.exit_code in (0, 5, 10), made.output
    artifact = read_artifact(Path("artifacts/rover/certificate.h5"), Certificate)
    assert artifact.record.tubes.references.shape == (1, 13, 5)
    assert artifact.header.config["dynamics"]["name"] == "rover" and "plugins" not in artifact.header.config
    planner = artifact.header.config["planner"]
    assert planner == {"name": "detour"}


def test_the_tutorials_harder_question_is_about_the_files_that_are_there(rover):
    """With next to no training, which stands in the experiment here."""
    Path("conf/experiment/rover.yaml").rename("conf/experiment/whole.yaml")
    Path("conf/experiment/rover.yaml").write_text(
        "# @package _global_\ndefaults: [whole, override /planner: detour, _self_]\nname: rover\nhorizon: 12\n"
        "tracker_training: {steps: 3, tube_steps: 0, references: 2, rollout_steps: 4, tube: null}\n"
    )
    assert rover("run", "--until", "train-tracker").exit_code == 0
    commands = [line for line in Path("README.md").read_text().splitlines() if line.startswith("sagemp verify")]
    assert len(commands) == 1
    asked = rover(*shlex.split(commands[0])[1:], "verify.samples=0", "verify.falsifier.restarts=0")
    assert asked.exit_code in (0, 5, 10), asked.output


def test_an_artifact_of_a_robot_that_nobody_here_knows_is_one_line_and_loads_nothing(rover, monkeypatch):
    short = ("horizon=12", "tracker_training.steps=3", "tracker_training.tube_steps=0", "tracker_training.references=2")
    short += ("tracker_training.rollout_steps=4", "tracker_training.tube=null")
    rover("run", "--until", "train-tracker", "planner=detour", *short)
    Path("conf/project.yaml").write_text("experiment: rover\n")  # nobody names rover.py any more
    registry._registered.clear()
    del sys.modules["rover"]
    refused = rover("verify", "planner=diffusion", *short)
    assert refused.exit_code == 2 and len(refused.stderr.splitlines()) == 1
    assert "dynamics.name 'rover': no such robot" in refused.stderr and "--plugin FILE.py" in refused.stderr
    assert "rover" not in sys.modules
    again = rover("--plugin", "rover.py", "status", "planner=detour", *short)
    assert again.exit_code == 0 and "tracker.h5" in again.stdout


def test_its_tests_pass(rover):
    environment = {"PYTHONPATH": str(Path(registry.__file__).parents[2]), "PATH": "", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    tested = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert tested.returncode == 0, tested.stdout
    assert "4 passed" in tested.stdout


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("My-Robot", "a robot's name must be lower-case letters, digits and underscores"),
        ("class", "a robot's name must be"),
        ("unicycle", "'unicycle' is a robot of this package"),
        ("there", "there: exists already; nothing is replaced"),
    ],
)
def test_a_name_that_cannot_be_is_refused_and_nothing_is_written(sagemp, name, message):
    Path("there").mkdir()
    refused = sagemp("init", name)
    assert refused.exit_code == 2 and message in refused.stderr
    assert [p.name for p in Path().iterdir()] == ["there"]


def test_code_that_an_artifact_names_is_never_loaded(rover, example):
    """Whatever a file says: a module, a path, a list of plugins; only names that are known here are looked up."""
    Path("evil_plugin.py").write_text("from pathlib import Path\nPath('loaded').write_text('')\n")
    for picked in ("evil_plugin", "evil_plugin.py", "evil_plugin:x", "./evil_plugin.py"):
        config = compose([]) | {"plugins": ["evil_plugin.py", "evil_plugin"], "experiment": "./evil_plugin.py"}
        config["planner"] = {"name": picked, "_target_": "evil_plugin.x", "path": "evil_plugin.py"}
        config["dynamics"] = config["dynamics"] | {"name": picked}
        header = Header(stage="verify", experiment="rover", config=config, seed=0)
        path = write_artifact(Path("certificate.h5"), example(Certificate), header, overwrite=True)
        for command in (("inspect", path), ("check", path)):
            assert rover(*command).exit_code in (0, 2, 5), command
        record = dataclasses.replace(example(PlannerModel), arguments="{}")
        planner = write_artifact(Path("planner.h5"), record, header, overwrite=True)
        with pytest.raises(ArtifactError, match="planner.h5: planner.name '.*': no such planner"):
            planner_from(read_artifact(planner, PlannerModel))
    assert not Path("loaded").exists() and "evil_plugin" not in sys.modules
