"""Stages from outside: what a name may be, and where they come from."""

from __future__ import annotations

import dataclasses
import sys
import types
from importlib import metadata

import pytest

from sagemp_cli.cli.main import app
from sagemp_cli.config.composition import compose
from sagemp_cli.errors import ConfigError
from sagemp_cli.pipeline.outline import ConfigOptions, require_sound_outline
from sagemp_cli.pipeline.stage import all_stages, stage_named, stages_of
from sagemp_cli.plugins import stage, stages
from sagemp_cli.storage import KINDS
from sagemp_cli.storage.kinds import own_kinds
from sagemp_cli.storage.record import scalar


@dataclasses.dataclass(frozen=True, kw_only=True)
class Count:
    """How many."""

    count: int = scalar("how many")


def nothing(context, inputs):
    """Do nothing."""


def test_names_of_commands_sections_and_kinds_are_taken():
    commands = {command.name for command in app.registered_commands} | {group.name for group in app.registered_groups}
    sections = {field.name.replace("_", "-") for field in dataclasses.fields(ConfigOptions)}
    assert commands | sections | {kind.name for kind in KINDS} <= stages.TAKEN


@pytest.mark.parametrize("name", ["verify", "planner", "library"])
def test_a_name_of_the_package_stays_what_it_is(folder, name):
    with pytest.raises(ConfigError, match=f"stage '{name}': the name is taken by this package"):
        stage(name, record=Count)


@pytest.mark.parametrize("name", ["", "Plan", "a_b", "../a", "a-", "-a", "1a", None])
def test_a_name_is_small_letters_with_hyphens(folder, name):
    with pytest.raises(ConfigError, match="a stage's name must be small letters, digits and hyphens"):
        stage(name, record=Count)


def test_two_functions_do_not_share_a_name(folder):
    stage("census", record=Count)(nothing)
    stage("census", record=Count)(nothing)  # a module that is imported again
    with pytest.raises(ConfigError, match="stage 'census': the name is taken by"):
        stage("census", record=Count)(lambda context, inputs: None)


def test_what_it_reads_is_there_before_it_and_its_name_may_be_a_section(folder):
    stage("census", record=Count, inputs=["train-planner"], sections=["library.size"])(nothing)
    stage("second-census", record=dataclasses.make_dataclass("Other", []), inputs=["census"])(nothing)
    config = compose()
    assert stage_named("second-census").inputs_in(config) == ("census",)
    assert [s.name for s in stages_of(config)][-2:] == ["census", "second-census"]
    assert [s.name for s in stages_of(config, ("census",))] == ["gen-data", "train-planner", "census"]
    assert stage_named("census").difference(compose(["library.size=1"]), compose(["library.size=2"]))
    require_sound_outline(config | {"second_census": {"anything": 1}})
    with pytest.raises(ConfigError, match=r"third_census: no such option \(did you mean 'second_census'|third_census"):
        require_sound_outline(config | {"third_census": {}})
    stage("lost", record=Count, inputs=["train-planer"])(nothing)
    with pytest.raises(ConfigError, match="stage 'lost': no stage 'train-planer' whose file it could read .*did you"):
        all_stages()


@pytest.mark.parametrize("record", [int, dataclasses.make_dataclass("Plain", ["x"]), KINDS[0].record])
def test_a_record_is_declared_and_its_own(folder, record):
    stage("census", record=record)(nothing)
    with pytest.raises(ConfigError, match="stage 'census': its record must be a dataclass of its own"):
        own_kinds()


@pytest.fixture
def installed(folder, monkeypatch):
    """``installed("name", text_of_module)`` is a package with a stage by entry point."""

    def install(name, text):
        (folder / "census_package.py").write_text(text)
        monkeypatch.syspath_prepend(folder)
        entry = metadata.EntryPoint(name, "census_package:made", stages.GROUP)
        fake = types.SimpleNamespace(entry_points=lambda *, group: [entry] if group == stages.GROUP else [])
        monkeypatch.setattr(stages, "metadata", fake)

    yield install
    sys.modules.pop("census_package", None)


PACKAGE = f"""
from sagemp_cli.plugins import stage
from {__name__} import Count

@stage("census", record=Count)
def made(context, inputs):
    return Count(count=3)
"""


def test_an_installed_package_brings_a_stage_by_entry_point(installed):
    installed("census", PACKAGE)
    assert [s.name for s in all_stages()][-1] == "census" and own_kinds()[-1].record is Count


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("other", PACKAGE, "registers no such stage"),
        ("census", "made = 1 / 0", "does not load: ZeroDivisionError"),
    ],
)
def test_a_package_that_does_not_bring_what_it_says_is_one_line(installed, name, text, message):
    installed(name, text)
    with pytest.raises(ConfigError, match=f"stage '{name}' of an installed package .*{message}"):
        all_stages()
