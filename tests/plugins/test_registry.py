"""Names of robots, planners and others: one table, and nothing else can be reached through it."""

from __future__ import annotations

import importlib
import inspect
from importlib import metadata

import pytest

from sagemp_cli.errors import ConfigError
from sagemp_cli.plugins import KINDS, planner, registry, robot
from sagemp_cli.plugins.registry import declared, from_outside, names, resolve


@pytest.mark.parametrize(("section", "name"), [(s, n) for s, kind in KINDS.items() for n in kind.built_in])
def test_every_name_of_the_package_is_a_class_of_it(section, name):
    found = resolve(section, name, section)
    assert inspect.isclass(found) and found.__module__.startswith("sagemp_cli.")


@pytest.mark.parametrize(
    ("section", "attribute"), [(s, attribute) for s, kind in KINDS.items() for attribute in kind.said]
)
def test_what_the_table_says_of_a_class_the_class_says_itself(section, attribute):
    kind = KINDS[section]
    assert kind.said[attribute] == {name: getattr(resolve(section, name, section), attribute) for name in kind.built_in}


def test_what_a_plugin_says_of_itself_counts(folder):
    planner("pupil")(type("Pupil", (), {"learns_from": "demonstrations"}))
    planner("plain")(lambda: None)
    assert declared("planner", "pupil", "planner", "learns_from", None) == "demonstrations"
    assert declared("planner", "plain", "planner", "learns_from", None) is None


def test_what_is_registered_is_found_under_its_name(folder):
    @planner("waltz")
    def waltz():
        """A planner."""

    assert resolve("planner", "waltz", "planner") is waltz
    assert from_outside("planner") == ["waltz"] and "waltz" in names("planner")
    with pytest.raises(ConfigError, match="tracker.name 'waltz': no such tracker"):
        resolve("tracker", "waltz", "tracker")


@pytest.mark.parametrize("name", ["", "a.b", "a b", "../a", "1a", None, 3])
def test_a_name_is_a_plain_word(folder, name):
    with pytest.raises(ConfigError, match="a robot's name must be letters, digits and underscores"):
        robot(name)(object)


def test_a_name_that_is_taken_stays_what_it_is(folder):
    with pytest.raises(ConfigError, match="robot 'unicycle' of .*: the name is taken by this package"):
        robot("unicycle")(type("Mine", (), {}))
    robot("rover")(type("First", (), {}))
    with pytest.raises(ConfigError, match="the name is taken by"):
        robot("rover")(type("Second", (), {}))


def test_a_module_that_is_imported_again_may_register_again(folder):
    robot("rover")(type("Rover", (), {}))
    robot("rover")(type("Rover", (), {}))


def entries(monkeypatch, **values):
    made = [metadata.EntryPoint(n, v, "sagemp.robots") for n, v in values.items()]

    def entry_points(*, group, name=None):
        return [e for e in made if group == "sagemp.robots" and name in (None, e.name)]

    monkeypatch.setattr(registry.metadata, "entry_points", entry_points)


def test_an_installed_package_brings_a_robot_by_an_entry_point(folder, monkeypatch):
    entries(monkeypatch, rover="sagemp_cli.dynamics.unicycle:Unicycle")
    assert from_outside("dynamics") == ["rover"]
    assert resolve("dynamics", "rover", "dynamics").__name__ == "Unicycle"


@pytest.mark.parametrize(
    ("value", "message"),
    [("no.such.module:X", "does not load: ModuleNotFoundError"), ("sagemp_cli.errors:EXIT_USAGE", "a class is needed")],
)
def test_an_entry_point_that_does_not_load_is_one_line(folder, monkeypatch, value, message):
    entries(monkeypatch, rover=value)
    with pytest.raises(ConfigError, match=message):
        resolve("dynamics", "rover", "dynamics")


def test_resolving_a_name_imports_nothing_that_the_table_does_not_name(folder, monkeypatch):
    (folder / "evil.py").write_text("raise SystemExit('loaded')")
    asked = []
    monkeypatch.setattr(registry.importlib, "import_module", lambda name: asked.append(name))
    for name in ("evil", "evil.py", "evil:x", "./evil.py", "os", "os:system", "sagemp_cli.dynamics.unicycle:Unicycle"):
        for section in KINDS:
            with pytest.raises(ConfigError, match="no such"):
                resolve(section, name, section)
    assert asked == []
    assert importlib.import_module is not None
