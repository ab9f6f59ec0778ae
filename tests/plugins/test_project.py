"""A project's own folder: its config files go before the package's, its plugins are known to all commands."""

from __future__ import annotations

import re
import sys

import pytest

from sagemp_cli.config.composition import compose, options_of
from sagemp_cli.config.folders import config_file
from sagemp_cli.errors import ConfigError
from sagemp_cli.pipeline.requirements import require_sound_config
from sagemp_cli.plugins.project import current_project
from sagemp_cli.plugins.registry import resolve

CASE = """# @package _global_
defaults:
  - unicycle_node
  - override /planner: {planner}
  - _self_
name: {name}
"""


def write(folder, path, text):
    (folder / path).parent.mkdir(parents=True, exist_ok=True)
    (folder / path).write_text(text)


def test_a_folder_without_config_is_a_project_that_says_nothing(folder):
    assert current_project().plugins == () and current_project().conf is None


def test_plugins_of_the_project_are_options_without_a_config_file(folder, write_planner):
    write_planner("fourth_plugin.py", "fourth")
    write(folder, "conf/project.yaml", "plugins: [fourth_plugin.py]")
    assert "fourth" in options_of("planner") and config_file("planner", "fourth") is None
    config = compose(["planner=fourth", "+planner.bulge=1.5"])
    assert config["planner"] == {"name": "fourth", "bulge": 1.5}
    require_sound_config(config)
    with pytest.raises(ConfigError, match=r"planner.bulg: plan has no such option \(did you mean 'bulge'"):
        require_sound_config(compose(["planner=fourth", "+planner.bulg=1.5"]))


def test_files_of_the_project_go_before_those_of_the_package(folder):
    write(folder, "conf/propagator/affine.yaml", "name: affine\nsymbols: 7")
    write(folder, "conf/experiment/mine.yaml", CASE.format(planner="flow_matching", name="mine"))
    write(folder, "conf/project.yaml", "experiment: mine")
    config = compose([])
    assert (config["name"], config["planner"]["name"], config["propagator"]["symbols"]) == ("mine", "flow_matching", 7)
    assert {"mine", "unicycle_node"} <= set(options_of("experiment"))
    assert compose(["experiment=unicycle_node"])["name"] == "unicycle_node"


TWO_MEANINGS = [
    ("budget: 010", "'010' can be read in two ways"),
    ("budget: 1:30", "'1:30' can be read in two ways"),
    ("budget: yes", "'yes' can be read in two ways"),
    ("budget: 2\nbudget: 3", "the key 'budget' is there twice"),
    ("budget: &a 2\nmemory: *a", "holds an alias"),
    ("budget: !!int '2'", "holds a tag"),
    ("budget: [", "expected the node content"),
]


@pytest.mark.parametrize(("said", "message"), TWO_MEANINGS)
@pytest.mark.parametrize(
    ("where", "override"),
    [
        ("conf/experiment/mine.yaml", "experiment=mine"),
        ("mine.yaml", "experiment=mine.yaml"),
        ("conf/effort/mine.yaml", "effort=mine"),
    ],
)
def test_a_config_that_can_be_read_in_two_ways_is_refused_with_file_and_line(folder, where, override, said, message):
    write(folder, where, f"# @package _global_\n\nlibrary:\n  {said.replace(chr(10), chr(10) + '  ')}\n")
    with pytest.raises(ConfigError) as caught:
        compose([override])
    told = str(caught.value)
    assert where in told and message in told and re.search("line [45]", told) and "\n" not in told


def test_plain_files_of_a_project_are_read_as_ever(folder):
    write(
        folder, "conf/effort/mine.yaml", "# @package _global_\neffort: {name: mine, suffix: '-m'}\nlibrary: {size: 3}"
    )
    write(folder, "conf/propagator/nothing.yaml", "")
    assert compose(["effort=mine"])["library"]["size"] == 3
    assert "nothing" in options_of("propagator")


def test_another_applications_config_folder_does_not_replace_ours(folder):
    write(folder, "conf/config.yaml", "defaults: [db: mysql]")
    assert compose([])["name"] == "unicycle_node"


def test_an_experiment_may_be_any_file(folder):
    write(folder, "some where/it's mine.yaml", CASE.format(planner="diffusion", name="mine"))
    assert compose(["experiment='some where/it\\'s mine.yaml'"])["name"] == "mine"
    write(folder, "other.yaml", "# @package _global_\ndefaults: [unicycle_node, _self_]\nhorizon: 7")
    assert compose(["experiment=other.yaml"])["horizon"] == 7
    with pytest.raises(ConfigError, match="experiment=othr.yaml: no such file; known experiments: kinematic_node"):
        compose(["experiment=othr.yaml"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("plugin: [a.py]", r"conf/project.yaml: unknown key 'plugin' \(did you mean 'plugins'"),
        ("plugins: a.py", "plugins must be a list of Python files or modules, found 'a.py'"),
        ("experiment: 3", "experiment must be a name, found 3"),
        ("[1]", "must be a mapping with the keys plugins, experiment"),
        ("a: [", "conf/project.yaml: not readable as YAML .line 1: expected the node content"),
        ("plugins: [nowhere.py]", "plugin nowhere.py: no such file"),
        ("experiment: nowhere", "nowhere"),
    ],
)
def test_a_project_that_cannot_be_is_one_line(folder, text, message):
    write(folder, "conf/project.yaml", text)
    with pytest.raises(ConfigError, match=message) as caught:
        compose([])
    assert "\n" not in str(caught.value)


def test_plugins_in_a_config_load_nothing(folder, write_planner):
    """Only the project's own file and the command line name code: no experiment, no override, no artifact does."""
    write_planner("fifth_plugin.py", "fifth")
    config = compose(["+plugins=[fifth_plugin.py]"])
    assert config["plugins"] == ["fifth_plugin.py"] and "fifth_plugin" not in sys.modules
    with pytest.raises(ConfigError, match="plugins: no such option"):
        require_sound_config(config)
    with pytest.raises(ConfigError, match="planner.name 'fifth': no such planner"):
        resolve("planner", "fifth", "planner")
    assert "fifth_plugin" not in sys.modules
