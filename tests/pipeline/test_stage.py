"""What a stage's output depends on in a config."""

from __future__ import annotations

import copy

import pytest

from sagemp_cli.config.composition import compose
from sagemp_cli.pipeline.stage import STAGES, stage_named


@pytest.mark.parametrize("stage", STAGES, ids=lambda s: s.name)
def test_where_the_work_is_done_makes_no_file_stale(stage):
    other = compose(["expert.processes=7", "executor=serial", "artifacts=elsewhere"])
    assert stage.difference(compose(), other) is None


def test_the_first_key_that_differs_is_named_with_both_values():
    found, wanted = compose(["proof.budget=7"]), compose()
    assert stage_named("verify").difference(found, wanted) == ("proof.budget", 7, 64)
    assert stage_named("build-library").difference(found, wanted) == ("proof.budget", 7, 64)
    assert stage_named("train-tracker").difference(found, wanted) is None


def test_a_key_that_one_config_does_not_have_is_named():
    found = compose()
    del found["propagator"]["symbols"]
    assert stage_named("verify").difference(found, compose()) == ("propagator.symbols", "nothing", None)


def test_finished_pieces_may_depend_on_less_than_the_output():
    gen_data = stage_named("gen-data")
    assert "count" in gen_data.settings(compose())["expert"]
    assert "count" not in gen_data.settings(compose(), without=("expert.count",))["expert"]


@pytest.mark.parametrize("experiment", ["unicycle_node", "unicycle_node_learned"])
def test_keys_that_came_later_do_not_make_older_files_stale(experiment):
    now = compose([f"experiment={experiment}"])
    older = copy.deepcopy(now)
    older["dynamics"].pop("time", None)
    older["dynamics"].get("model", {}).pop("time", None)
    older["proof"] = {k: v for k, v in older["proof"].items() if k not in ("substeps", "order")}
    stage = stage_named("verify")
    assert stage.difference(older, now) is None and stage.difference(now, older) is None
    asked = compose([f"experiment={experiment}", "proof.substeps=2"])
    assert stage.difference(older, asked) == ("proof.substeps", "auto", 2)
