"""YAML and JSON of somebody else: what can be read in two ways is refused, and nothing costs more than it is long."""

from __future__ import annotations

import pytest
import yaml

from sagemp_cli.reading.plain_json import plain_mapping
from sagemp_cli.reading.plain_yaml import plain_yaml


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nb: {radius: 0.25, radius: 0.01}", "line 2: the key 'radius' is there twice"),
        ("a: 010", "line 1: '010' can be read in two ways"),
        ("a: 1:30", "'1:30' can be read in two ways"),
        ("a: yes", "'yes' can be read in two ways"),
        ("- on", "'on' can be read in two ways"),
        ("no: 1", "'no' can be read in two ways"),
        ("a: 1_000", "'1_000' can be read in two ways"),
        ("a: 0x10", "'0x10' can be read in two ways"),
        ("a: 1_0.5", "'1_0.5' can be read in two ways"),
        ("a: 2026-01-01", "'2026-01-01' can be read in two ways"),
        ("a: !!int '010'", "holds a tag"),
        ("a: &b [1]\nc: *b", "line 2 holds an alias"),
        ("<<: {a: 1}", "'<<' can be read in two ways"),
        ("? [a]\n: 1", "a key must be a text or a number"),
        ("a: " + 2000 * "[" + 2000 * "]", "nested more than 100 levels deep"),
        ("a" * 100_001, "more than 100000"),
    ],
)
def test_yaml_that_can_be_misread_is_refused(text, message):
    with pytest.raises(ValueError, match=message.replace("[", r"\[")):
        plain_yaml(text)


def test_whatever_is_dumped_is_read_back():
    data = {
        "numbers": [0, -3, 10**40, 0.1, 1e-7, 1e300, float("inf"), -float("inf")],
        "texts": ["yes", "010", "1:30", "2026-01-01", "0x10", "1e5", "null", "", "=", "<<", "µ", "a: b", "*x", "!y"],
        "rest": [True, False, None, {}, []],
    }
    assert plain_yaml(yaml.safe_dump(data)) == data


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a": 1, "a": 2}', "has the key 'a' twice"),
        ("[1]", "must be a mapping, found list"),
        ("{", "is not JSON"),
        ('{"a": ' + 100_000 * "[" + "}", "is nested too deep"),
        (" " * 1_000_001, "at most 1000000 characters"),
        (7, "must be a text"),
    ],
)
def test_json_that_is_no_plain_mapping_is_refused(text, message):
    with pytest.raises(ValueError, match=message):
        plain_mapping(text, "arguments")
