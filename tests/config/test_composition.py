"""Configs: every option composes and binds, and a wrong override is one line with the nearest known name."""

from __future__ import annotations

import re

import pytest
import yaml

from sagemp_cli.config.composition import chosen_options, compose, groups, options_of
from sagemp_cli.config.folders import load_scene, resource_folder
from sagemp_cli.errors import ConfigError
from sagemp_cli.pipeline.requirements import require_sound_config

OPTIONS = [(group, option) for group in groups() for option in options_of(group)]


@pytest.mark.parametrize(("group", "option"), OPTIONS, ids=lambda v: v)
def test_every_option_of_every_group_composes_and_fits_what_it_configures(group, option):
    # start, scene and disturbance belong to an experiment's robot, not to every robot there is
    require_sound_config(compose([f"{group}={option}"]), problem=group not in ("dynamics", "toy"))


@pytest.mark.parametrize("effort", options_of("effort"))
@pytest.mark.parametrize("experiment", options_of("experiment"))
def test_every_experiment_is_sound_at_every_effort(experiment, effort):
    require_sound_config(compose([f"experiment={experiment}", f"effort={effort}"]))


def test_there_are_options_for_every_part_of_the_pipeline():
    assert {
        "dynamics",
        "planner",
        "tracker",
        "tracker_training",
        "propagator",
        "experiment",
        "effort",
        "expert",
    } <= set(groups())


def test_the_resolved_config_is_plain_data_that_yaml_keeps_exactly():
    config = compose()
    assert yaml.safe_load(yaml.safe_dump(config)) == config


def test_the_scene_is_part_of_the_config():
    assert compose()["scene"] == yaml.safe_load((resource_folder("data") / "scenes" / "slalom.yaml").read_text())


def test_a_scene_may_be_any_file(tmp_path):
    (tmp_path / "mine.yaml").write_text("name: mine")
    assert compose([f"scene={tmp_path}/mine.yaml"])["scene"] == {"name": "mine"}


@pytest.mark.parametrize("overrides", [["effort=demo"], ["effort=toy"]])
def test_an_effort_changes_what_config_yaml_says(overrides):
    assert compose(overrides)["effort"]["name"] == overrides[0].partition("=")[2]


def test_overrides_come_last(tmp_path):
    config = compose(["effort=toy", "horizon=7", "dynamics.dt=0.05", "start.radius=[0.1,0.2,0,0]"])
    assert (config["horizon"], config["dynamics"]["dt"], config["start"]["radius"]) == (7, 0.05, [0.1, 0.2, 0, 0])


def test_one_number_for_a_list_stands_for_as_many_as_it_has():
    assert compose(["tracker.hidden=16"])["tracker"]["hidden"] == [16, 16]
    assert compose(["disturbance.radius=0.0"])["disturbance"]["radius"] == [0.0] * 4


def test_the_readme_example_works():
    hidden = compose(["experiment=unicycle_node", "planner.hidden=64"])["planner"]["hidden"]
    assert set(hidden) == {64}


def test_the_chosen_options_are_known():
    assert chosen_options()["propagator"] == "affine"
    assert chosen_options(["propagator=auto_lirpa"])["propagator"] == "auto_lirpa"


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "experiment=unicycle_nod",
            "experiment=unicycle_nod: unknown experiment (did you mean 'unicycle_node'?); known: ",
        ),
        ("propagator=crwn", "propagator=crwn: unknown propagator (did you mean 'crown'?)"),
        ("planner=null", "planner=None: unknown planner"),
        ("horizn=3", "horizn: unknown key (did you mean 'horizon'?)"),
        ("tracker.hiden=8", "tracker.hiden: unknown key (did you mean 'tracker.hidden'?)"),
        ("zzz=8", "zzz: unknown key; known at the top: artifacts, "),
        ("horizon", "'horizon' is not an override of the form key=value"),
        ("start.radius=[1", "'start.radius=[1' is not an override of the form key=value"),
        ("seed=0,1", "seed=0,1: sweeps are not supported"),
        ("seed=abc", "seed must be a whole number of at least 0, found 'abc'"),
        ("seed=1.5", "seed must be a whole number of at least 0, found 1.5"),
        ("horizon=true", "horizon must be a whole number of at least 1, found True"),
        ("start=3", "start is a section, found 3; its keys: center, radius"),
        ("scene=slalm", "scene 'slalm': no such scene (did you mean 'slalom'?); known: "),
        ("scene=/nowhere/s.yaml", "scene '/nowhere/s.yaml': no such file (looked for /nowhere/s.yaml)"),
        ("~horizon", "horizon"),
    ],
)
def test_a_wrong_override_is_one_line_that_names_it(override, message):
    with pytest.raises(ConfigError, match=re.escape(message)) as caught:
        require_sound_config(compose([override]))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["start.radius=[-1,1,0,0]"], "start.radius must not be negative, found -1.0 for px"),
        (["start.radius=[0,0,0,0]"], "start.radius must be positive in at least one of px, py, theta, v"),
        (["start.radius=[.inf,0,0,0]"], "start.radius must"),
        (["start.center=[nan,0,0,0]"], "start.center must hold finite numbers"),
        (["disturbance.radius=[0.1]"], "disturbance.radius needs 4 numbers, found 1"),
        (
            ["proof.partitions=0"],
            "proof.partitions must be a positive number of cells in all, 2 counts such as 2x2, or auto; found 0",
        ),
        (
            ["proof.partitions=4x"],
            "proof.partitions must be a positive number of cells in all, 2 counts such as 2x2, or auto; found '4x'",
        ),
        (["proof.partitions=2x2x2"], "found 3 counts in '2x2x2'"),
        (["proof.budget=0"], "proof.budget must be a whole number of at least 1, found 0"),
        (["proof.memory=0"], "proof.memory must be a positive number of GiB, found 0"),
        (["proof.memory=nan"], "proof.memory must be a positive number of GiB, found nan"),
        (["executor.workers=0"], "executor.workers must be a whole number of at least 1 or null, found 0"),
        (["executor.least=-1"], "executor.least must be a whole number of at least 0, found -1"),
        (
            ["executor=dask", "executor.address=here"],
            "executor.address must be that of a Dask scheduler such as tcp://",
        ),
        (["horizon=0"], "horizon must be a whole number of at least 1, found 0"),
        (["dynamics.dt=-1"], "dynamics.dt must be a positive number of seconds, found -1"),
        (["dynamics.dt=fast"], "dynamics.dt must be a positive number of seconds, found 'fast'"),
        (
            ["tracker.hidden=[a,b]"],
            "tracker.hidden must be a non-empty list of whole numbers of at least 1",
        ),
        (["+tracker.width=3"], "tracker.width: Tracker has no such option"),
        (["+expert.contrl=3"], "expert.contrl"),
        (["+tracker_training.stepz=3"], "tracker_training.stepz"),
        (["+planner_training.stepz=3"], "planner_training.stepz"),
        (["+verify.falsifier.restart=3"], "verify.falsifier.restart"),
        (["verify.falsifier.restarts=-1"], "verify.falsifier.restarts must be a whole number of at least 0, found -1"),
        (["planner_training.held_out=2.0"], "planner_training.held_out must be a number in (0, 1), found 2.0"),
        (["expert.count=0"], "expert.count must be a whole number of at least 1, found 0"),
        (
            ["tracker_training.references=0"],
            "tracker_training.references must be a whole number of at least 1, found 0",
        ),
        (["library.size=9", "library.budget=8"], "library.budget must be at least library.size, 9; found 8"),
        (["library.start_spread=2"], "library.start_spread must be a share of X_I in [0, 1], found 2"),
        (["execute.queries=0"], "execute.queries must be a whole number of at least 1, found 0"),
        (["safety.within_limits=1"], "safety.within_limits must be true or false, found 1"),
        (["propagator.name=os.system"], "propagator.name 'os.system': no such propagator"),
        (
            ["planner.hidden=[64,-3]"],
            "planner.hidden must be a non-empty list of whole numbers of at least 1",
        ),
        (["planner_training.learning_rate=-1"], "planner_training.learning_rate must be a positive number, found -1"),
        (["tracker_training.learning_rate=nan"], "tracker_training.learning_rate must be a positive number, found nan"),
        (["tracker_training.steps=0"], "tracker_training.steps must be a whole number of at least 1, found 0"),
        (["tracker_training.weights.track=-1"], "tracker_training.weights.track must be a number of at least 0"),
        (["tracker_training.tube.scal=1"], "tracker_training.tube.scal"),
        (["seed=-1"], "seed must be a whole number of at least 0, found -1"),
        (["planner.method=eulr"], "planner.method must be one of euler, rk4, found 'eulr' (did you mean 'euler'?)"),
        (["+planer_training={}"], "planer_training: no such option (did you mean 'planner_training'?)"),
    ],
)
def test_a_config_that_cannot_work_is_refused_before_any_work(overrides, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        require_sound_config(compose(overrides))


def test_a_seed_that_stages_take_over_is_complained_of_once():
    with pytest.raises(ConfigError) as caught:
        require_sound_config(compose(["seed=-1", "verify.seed=-2"]))
    wrong = "seed must be a whole number of at least 0, found"
    assert str(caught.value) == f"{wrong} -1; verify.{wrong} -2"


def test_all_complaints_come_at_once():
    with pytest.raises(ConfigError) as caught:
        require_sound_config(compose(["dynamics.dt=fast", "+tracker.width=3", "+tracker_training.stepz=1"]))
    assert all(key in str(caught.value) for key in ("dynamics.dt", "tracker.width", "tracker_training.stepz"))


@pytest.mark.parametrize(
    ("text", "message"),
    [("- a\n- b", "must hold a mapping, found list"), ("a: [", "not readable as YAML"), ("\xff", "")],
)
def test_a_scene_file_that_is_none_is_refused(tmp_path, text, message):
    path = tmp_path / "s.yaml"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(ConfigError, match=f"scene file {path}: .*{message}"):
        load_scene(str(path))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("obstacles:\n- {kind: ball, radius: 0.25, radius: 0.01}", "line 2: the key 'radius' is there twice"),
        ("workspace: {lower: [010, 1:30], upper: [yes, 4]}", "'010' can be read in two ways"),
        ("a: " + 2000 * "[" + 2000 * "]", "nested more than 100 levels deep"),
        ("a: &x 1\nb: *x", "alias"),
        ("[", "not readable as YAML"),
        ("a: 1\n" * 200_001, "is larger than"),
    ],
)
def test_a_scene_file_that_can_be_misread_is_refused(tmp_path, text, message):
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match="scene file .*scene.yaml: ") as error:
        load_scene(str(path))
    assert message in str(error.value)


def test_a_scene_given_too_deep_or_by_a_pipe_is_one_line(tmp_path):
    import os

    os.mkfifo(tmp_path / "scene.yaml")
    with pytest.raises(ConfigError, match="scene.yaml: is a pipe"):
        load_scene(str(tmp_path / "scene.yaml"))
    with pytest.raises(ConfigError, match="nested too deep"):
        compose(["scene=" + "{a:" * 2000 + "1" + "}" * 2000])


@pytest.mark.parametrize("text", ["${ or", "${", "a ${b", "${oc.env:", "${scene"])
def test_an_experiments_file_with_half_an_interpolation_is_refused_in_one_line(tmp_path, text):
    path = tmp_path / "mine.yaml"
    path.write_text(f'scene: "{text}"\n')
    with pytest.raises(ConfigError, match=f"experiment file {path}: ") as caught:
        compose([f"experiment={path}"])
    assert "\n" not in str(caught.value)
