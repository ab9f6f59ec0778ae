"""What Tab completes."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from sagemp_cli.cli.completion import complete_override, complete_stage


def context(*words):
    return SimpleNamespace(params={"overrides": list(words)})


@pytest.mark.parametrize(
    ("words", "typed", "wanted"),
    [
        ([], "experiment=unicycle_v", ["experiment=unicycle_vlm", "experiment=unicycle_vlm_avoid"]),
        ([], "planner.hid", ["planner.hidden="]),
        ([], "planner_tr", ["planner_training=", "planner_training.steps=", "planner_training.learning_rate="]),
        (["planner=diffusion"], "planner.kn", ["planner.knots="]),
        (["experiment"], "unicycle_v", ["unicycle_vlm", "unicycle_vlm_avoid"]),  # bash splits at "="
        (["seed", "=", "3", "planner", "="], "fl", ["flow_matching"]),
        (["seed", "=", "3"], "horiz", ["horizon="]),
        (["oops", "seed=3"], "nothing_like_it", []),
        (["planner=nonsense"], "planner.h", []),
    ],
)
def test_overrides_are_completed(words, typed, wanted):
    assert complete_override(context(*words), typed)[: len(wanted) or None] == wanted


def test_stages_are_completed(sagemp):
    import typer

    from sagemp_cli.cli.main import app

    group = typer.main.get_command(app)
    root = SimpleNamespace(find_root=lambda: SimpleNamespace(command=group))
    assert complete_stage(root, "ver") == ["verify"]
    assert complete_stage(root, "") == [
        "gen-data", "train-dynamics", "train-planner", "train-tracker", "verify", "build-library", "execute",
        "safety-rates",
    ]  # fmt: skip
