"""Objects from config sections: names from one registry, options checked against signatures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import pytest

from sagemp_cli.config.binding import Binding, build, option_complaints, options_for, section_complaints, target_class
from sagemp_cli.config.ranges import Count, Decay, NonNegative, Positive, Widths
from sagemp_cli.dynamics.unicycle import Unicycle
from sagemp_cli.errors import ConfigError
from sagemp_cli.stages.train_tracker import Options as TrackerSection

UNICYCLE = {
    "name": "unicycle",
    "dt": 0.1,
    "control_lower": [-1, -1],
    "control_upper": [1, 1],
    "state_lower": [-9, -9, -9, -9],
    "state_upper": [9, 9, 9, 9],
}
TRACKER = {"name": "mlp", "lookahead": 3, "hidden": [4]}


@dataclass(frozen=True)
class Tube:
    weight: NonNegative = 0.3
    counts: Sequence[Count] = (2, 2)
    scale: Sequence[Positive] | Positive = 0.1

    def __post_init__(self) -> None:
        if len(self.counts) > 3:
            raise ConfigError(f"at most 3 counts, found {len(self.counts)}")


def train(
    *,
    tracker: object,
    hidden: Widths,
    rate: Positive = 1.0,
    batch: Count = 1,
    decay: Decay | None = None,
    kind: Literal["plain", "certified"] = "plain",
    label: str | None = None,
    quiet: bool = False,
    tube: Tube | None = None,
) -> None:
    """What the sections of these tests are bound to."""


def complaints(**options):
    return option_complaints(train, {"hidden": [4]} | options, "training", given=("tracker",))


def test_a_section_becomes_the_object_that_it_describes():
    robot = build(UNICYCLE, "dynamics")
    assert type(robot) is Unicycle
    assert robot.dt == 0.1


@pytest.mark.parametrize(
    "name", ["os.system", "sagemp_cli.dynamics.unicycle:Unicycle", "Unicycle", "../evil.py", "", None, 3, ["unicycle"]]
)
def test_only_known_names_can_be_picked(name):
    with pytest.raises(ConfigError, match=r"x?dynamics.name .*: no such robot.*known: kinematic_unicycle, learned"):
        target_class({"name": name}, "dynamics")


def test_a_name_of_one_kind_is_none_of_another():
    with pytest.raises(ConfigError, match="planner.name 'unicycle': no such planner"):
        target_class({"name": "unicycle"}, "planner")


def test_a_section_of_an_earlier_version_is_refused_by_one_clear_line():
    with pytest.raises(ConfigError, match=r"dynamics._target_ 'sagemp_cli.*': made by an earlier version"):
        target_class({"_target_": "sagemp_cli.dynamics.unicycle.Unicycle"}, "dynamics")


def test_complaints_name_unknown_missing_and_mistyped_options_all_at_once():
    section = {k: v for k, v in UNICYCLE.items() if k != "dt"} | {"dtt": 0.1, "disturbance": 3, "state_lower": "low"}
    assert set(section_complaints(section, "dynamics")) == {
        "dynamics.state_lower must be a list of numbers, found 'low'",
        "dynamics.dtt: Unicycle has no such option (did you mean 'dt'?)",
        "dynamics.disturbance must be one of derivative, state, found 3",
        "dynamics: Unicycle needs dt",
    }


def test_options_of_the_base_class_are_options_of_a_class_that_hands_them_on():
    section = UNICYCLE | {"name": "planar_quadrotor", "dt": "fast", "mas": 1.0}
    del section["state_lower"]
    assert set(section_complaints(section, "dynamics")) == {
        "dynamics.dt must be a positive number of seconds, found 'fast'",
        "dynamics.mas: PlanarQuadrotor has no such option (did you mean 'mass'?)",
        "dynamics: PlanarQuadrotor needs state_lower",
    }


def test_arguments_that_come_from_the_robot_need_not_be_in_the_config_and_may_not():
    assert section_complaints(TRACKER, "tracker") == []
    assert section_complaints({"name": "mlp", "lookahead": 3}, "tracker") == ["tracker: Tracker needs hidden"]
    assert "no such option" in section_complaints(TRACKER | {"state_dim": 4}, "tracker")[0]
    with pytest.raises(ConfigError, match="tracker: Tracker needs state_dim, control_dim"):
        build(TRACKER, "tracker")
    assert build(TRACKER, "tracker", state_dim=4, control_dim=2).state_dim == 4


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("hidden", [64, -3], "a non-empty list of whole numbers of at least 1"),
        ("hidden", [1.5], "a non-empty list of whole numbers of at least 1"),
        ("hidden", [True], "a non-empty list of whole numbers of at least 1"),
        ("hidden", [], "a non-empty list of whole numbers of at least 1"),
        ("hidden", "12", "a non-empty list of whole numbers of at least 1"),
        ("rate", 0, "a positive number"),
        ("rate", float("nan"), "a positive number"),
        ("rate", float("inf"), "a positive number"),
        ("rate", True, "a positive number"),
        ("rate", "1", "a positive number"),
        ("batch", 1.0, "a whole number of at least 1"),
        ("decay", 1, "a number in [0, 1) or null"),
        ("kind", "certifed", "one of plain, certified"),
        ("label", 3, "a text or null"),
        ("quiet", 1, "true or false"),
    ],
)
def test_what_is_allowed_is_said_in_words(option, value, words):
    (complaint,) = complaints(**{option: value})
    assert complaint.startswith(f"training.{option} must be {words}, found {value!r}")


@pytest.mark.parametrize(
    ("option", "value"),
    [("rate", 1), ("decay", None), ("decay", 0), ("label", "x"), ("tube", None), ("hidden", [8, 8])],
)
def test_what_fits_is_not_complained_about(option, value):
    assert complaints(**{option: value}) == []


def test_a_section_within_a_section_becomes_the_object_that_the_function_takes():
    options = options_for(
        train, {"hidden": [4], "tube": {"weight": 1, "scale": [1, 2]}}, "training", given=("tracker",)
    )
    assert options == {"hidden": [4], "tube": Tube(weight=1.0, scale=[1.0, 2.0])}


def test_complaints_about_a_section_within_a_section_have_its_full_name():
    assert set(complaints(tube={"weight": -1, "scal": 1, "scale": [0]})) == {
        "training.tube.weight must be a number of at least 0, found -1",
        "training.tube.scale must be a list of positive numbers or a positive number, found [0]",
        "training.tube.scal: Tube has no such option (did you mean 'scale'?)",
    }
    assert complaints(tube=3) == ["training.tube must be a section, found 3; its keys: weight, counts, scale"]
    assert complaints(tube={"counts": [1, 1, 1, 1]}) == ["at most 3 counts, found 4"]


def test_a_long_value_is_cut_in_the_message():
    (complaint,) = complaints(label=["x" * 10_000])
    assert len(complaint) < 250


def test_a_binding_reads_its_section_and_what_the_stage_itself_takes_beside_it():
    binding = Binding("a.b", train, given=("tracker",), beside={"count": Count})
    assert binding.options({"a": {"b": {"hidden": [1], "count": 3}}}) == {"hidden": [1], "count": 3}
    assert binding.complaints({"a": {"b": {"hidden": [1], "count": 0}}}) == [
        "a.b.count must be a whole number of at least 1, found 0"
    ]
    assert binding.complaints({"a": {}}) == ["a.b: train needs hidden, count"]


def test_an_error_of_the_constructor_names_the_section():
    with pytest.raises(ConfigError, match="Unicycle: control_lower needs 2 numbers, found 1"):
        build(UNICYCLE | {"control_lower": [-1]}, "dynamics")


def test_options_that_a_section_inherits_are_checked_by_the_types_that_their_own_module_knows():
    """The stage's module knows no ``Decay``: its name alone would be any type there."""
    wrong = option_complaints(TrackerSection, {"steps": 2, "references": 1, "ema_decay": 2.0}, "tracker_training")
    assert wrong == ["tracker_training.ema_decay must be a number in [0, 1) or null, found 2.0"]
    wrong = option_complaints(TrackerSection, {"steps": 2, "references": 1, "warmup": 9}, "tracker_training")
    assert wrong == ["tracker_training: steps must be positive and 0 <= warmup < steps, found 2 and 9"]
