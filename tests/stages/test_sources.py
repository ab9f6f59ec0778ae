"""Files that an experiment takes from another one: where they are, who makes them, what is refused."""

import pytest

from sagemp_cli.config.composition import compose
from sagemp_cli.errors import ArtifactError, ConfigError
from sagemp_cli.pipeline.context import StageContext
from sagemp_cli.pipeline.freshness import Freshness, survey
from sagemp_cli.pipeline.requirements import require_sound_config
from sagemp_cli.pipeline.stage import stage_named, stages_of


def context(tmp_path, *overrides):
    return StageContext.of(compose(["effort=toy", f"artifacts={tmp_path}", *overrides]))


BORROWS = ("experiment=unicycle_node_plain", "sources.train-tracker=unicycle_node")


def test_a_borrowed_file_is_in_the_other_experiments_folder(tmp_path):
    here = context(tmp_path, *BORROWS)
    assert here.output_path("train-tracker") == tmp_path / "unicycle_node-toy" / "tracker.h5"
    assert here.output_path("train-planner") == tmp_path / "unicycle_node_plain-toy" / "planner.h5"


def test_the_other_experiment_gets_seed_and_effort_of_the_call(tmp_path):
    owner = context(tmp_path, *BORROWS, "seed=7").owner("train-tracker")
    assert (owner.config["name"], owner.config["seed"], owner.config["effort"]["name"]) == ("unicycle_node", 7, "toy")


def test_what_a_borrowed_file_is_made_from_is_the_other_experiments_affair(tmp_path):
    borrowed = {"train-planner": "unicycle_node", "train-tracker": "unicycle_node"}
    config = dict(compose([]), sources=borrowed)
    assert [s.name for s in stages_of(config, ("verify",))] == ["train-planner", "train-tracker", "verify"]
    assert [s.name for s in stages_of(compose([]), ("verify",))][0] == "gen-data"


def test_a_missing_borrowed_file_names_the_experiment_that_makes_it(tmp_path):
    with pytest.raises(ArtifactError, match="unicycle_node-toy/tracker.h5: missing; make it with .*unicycle_node'"):
        context(tmp_path, *BORROWS).read("train-tracker")
    assert survey(context(tmp_path, *BORROWS))["train-tracker"].freshness is Freshness.MISSING


def test_a_stage_whose_file_is_borrowed_does_not_run_here(tmp_path):
    with pytest.raises(ConfigError, match="unicycle_node_plain takes tracker.h5 from unicycle_node; make it with"):
        stage_named("train-tracker").run(context(tmp_path, *BORROWS))


@pytest.mark.parametrize(
    ("override", "text"),
    [
        ("+sources.verify=unicycle_node", "sources.verify: no stage whose file another one could use"),
        ("sources.train-tracker=unicycle_nod", "no experiment 'unicycle_nod' (did you mean 'unicycle_node'?)"),
        ("sources.train-tracker=unicycle_node", "unicycle_node is this experiment itself"),
    ],
)
def test_wrong_sources_are_refused_with_what_is_allowed(override, text):
    with pytest.raises(ConfigError) as error:
        require_sound_config(compose([override]))
    assert text in str(error.value)
