"""Plugins are modules that the person at the keyboard names; what is wrong with them is one line."""

from __future__ import annotations

import sys

import pytest

from sagemp_cli.errors import ConfigError
from sagemp_cli.plugins.loading import load
from sagemp_cli.plugins.registry import resolve


def test_a_file_and_a_module_are_loaded_by_name(write_planner):
    write_planner("first_plugin.py", "first")
    write_planner("package_of_plugins/second.py", "second")
    load("first_plugin.py")
    load("package_of_plugins.second")
    load("first_plugin.py")  # again: nothing happens
    assert resolve("planner", "first", "planner").__module__ == "first_plugin"
    assert resolve("planner", "second", "planner").__module__ == "package_of_plugins.second"


def test_nothing_beside_a_plugin_takes_the_place_of_another_module(write_planner, folder):
    (folder / "json.py").write_text("raise SystemExit('not the real one')")
    write_planner("third_plugin.py", "third")
    load("third_plugin.py")
    import json

    assert "loads" in vars(json) and sys.path[-1] == str(folder)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("broken_a.py", "x = 1\ny = z\n", "plugin broken_a.py: line 2: NameError: name 'z' is not defined"),
        ("broken_b.py", "def f(:\n", "plugin broken_b.py: line 1: SyntaxError"),
        ("broken_c.py", "import no_such_module_at_all\n", "line 1: ModuleNotFoundError"),
        (
            "broken_d.py",
            "from sagemp_cli.plugins import robot\nrobot('unicycle')(dict)\n",
            "plugin broken_d.py: robot 'unicycle' of builtins: the name is taken",
        ),
        ("my-robot.py", "", "'my-robot' is no name of a module"),
        ("json.py", "", "'json' is the name of another module"),
    ],
)
def test_a_plugin_that_cannot_be_loaded_is_one_line(folder, file, text, message):
    (folder / file).write_text(text)
    with pytest.raises(ConfigError) as caught:
        load(file)
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("plugin", "message"),
    [
        ("nowhere.py", "plugin nowhere.py: no such file"),
        ("../nowhere.py", "no such file"),
        ("no.such.module", "there is no module 'no.such.module'"),
    ],
)
def test_a_plugin_that_is_not_there_is_named(folder, plugin, message):
    with pytest.raises(ConfigError, match=message):
        load(plugin)
