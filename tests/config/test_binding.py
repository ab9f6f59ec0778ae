"""Objects from config sections: an allow-list for classes, signatures for options."""

from __future__ import annotations

import re

import pytest

from sagemp_cli.config.binding import all_complaints, build, complaints, target_class
from sagemp_cli.dynamics.unicycle import Unicycle
from sagemp_cli.errors import ConfigError

UNICYCLE = {
    "_target_": "sagemp_cli.dynamics.unicycle.Unicycle",
    "dt": 0.1,
    "control_lower": [-1, -1],
    "control_upper": [1, 1],
    "state_lower": [-9, -9, -9, -9],
    "state_upper": [9, 9, 9, 9],
}


def test_a_section_becomes_the_object_that_it_describes():
    robot = build(UNICYCLE, "dynamics")
    assert type(robot) is Unicycle
    assert robot.dt == 0.1


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "builtins.eval",
        "subprocess.Popen",
        "sagemp_cli.storage.artifact.Header",
        "sagemp_cli.pipeline.context.StageContext",
        "sagemp_cli.config.composition.Path",
        "sagemp_cli.dynamics",
        "sagemp_cli",
        "sagemp_cli.dynamics..unicycle.Unicycle",
        "sagemp_cli.dynamics.../os.system",
        "",
    ],
)
def test_only_classes_of_the_allowed_packages_may_be_named(target):
    with pytest.raises(
        ConfigError, match=re.escape(f"x._target_ '{target}' is not allowed; targets must be classes of")
    ):
        target_class({"_target_": target}, "x")


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("sagemp_cli.dynamics.unicycle.torch", "sagemp_cli.dynamics.unicycle defines no class torch"),
        ("sagemp_cli.dynamics.unicycle.Tensor", "sagemp_cli.dynamics.unicycle defines no class Tensor"),
        ("sagemp_cli.dynamics.unicycle.Dynamics", "sagemp_cli.dynamics.unicycle defines no class Dynamics"),
        ("sagemp_cli.dynamics.unicicle.Unicycle", "there is no module sagemp_cli.dynamics.unicicle"),
    ],
)
def test_imported_names_and_missing_modules_are_no_targets(target, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        target_class({"_target_": target}, "x")


def test_a_section_without_a_target_says_so():
    with pytest.raises(ConfigError, match="planner._target_ must name a class, found None"):
        target_class({}, "planner")


def test_complaints_name_unknown_missing_and_mistyped_options_all_at_once():
    section = {k: v for k, v in UNICYCLE.items() if k != "dt"} | {"dtt": 0.1, "disturbance": 3, "state_lower": "low"}
    assert complaints(section, "dynamics") == [
        "dynamics.state_lower must be list[float], found 'low'",
        "dynamics.dtt: Unicycle has no such option (did you mean 'dt'?)",
        "dynamics.disturbance must be str, found 3",
        "dynamics: Unicycle needs dt",
    ]


def test_options_of_the_base_class_are_options_of_a_class_that_hands_them_on():
    section = UNICYCLE | {"_target_": "sagemp_cli.dynamics.planar_quadrotor.PlanarQuadrotor", "dt": "fast", "mas": 1.0}
    del section["state_lower"]
    assert complaints(section, "dynamics") == [
        "dynamics.dt must be float, found 'fast'",
        "dynamics.mas: PlanarQuadrotor has no such option (did you mean 'mass'?)",
        "dynamics: PlanarQuadrotor needs state_lower",
    ]


def test_arguments_that_come_from_the_robot_need_not_be_in_the_config():
    section = {"_target_": "sagemp_cli.loop.tracker.Tracker", "lookahead": 3, "hidden": [4]}
    assert all_complaints({"tracker": section}) == []
    assert all_complaints({"tracker": {k: v for k, v in section.items() if k != "hidden"}}) != []
    with pytest.raises(ConfigError, match="tracker: Tracker needs state_dim, control_dim"):
        build(section, "tracker")
    assert build(section, "tracker", state_dim=4, control_dim=2).state_dim == 4


@pytest.mark.parametrize(
    ("value", "good"),
    [([1, 2], True), ([], True), ([1.5], False), ([True], False), (3, False), ("12", False), (None, False)],
)
def test_lists_of_whole_numbers_are_told_from_other_things(value, good):
    section = {"_target_": "sagemp_cli.loop.tracker.Tracker", "lookahead": 3, "hidden": value}
    assert (all_complaints({"tracker": section}) == []) == good


def test_optional_options_may_be_null():
    section = {"_target_": "sagemp_cli.loop.tracker.Tracker", "lookahead": 3, "hidden": [4], "error_scale": None}
    assert all_complaints({"tracker": section}) == []


def test_an_error_of_the_constructor_names_the_section():
    with pytest.raises(ConfigError, match="Unicycle: control_lower needs 2 numbers, found 1"):
        build(UNICYCLE | {"control_lower": [-1]}, "dynamics")
