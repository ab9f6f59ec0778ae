"""Trained modules from files whose arguments were made up."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest

from sagemp_cli.errors import ArtifactError
from sagemp_cli.loop.tracker import Tracker
from sagemp_cli.pipeline.models import tracker_from, weights_of
from sagemp_cli.storage import Artifact, Header, TrackerModel

RIGHT = {"state_dim": 4, "control_dim": 2, "lookahead": 3, "hidden": [4, 4], "negative_slope": 0.1}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (RIGHT | {"hidden": [10**8, 10**8]}, "needs more than 1024 MiB of memory"),
        (RIGHT | {"hidden": [1] * 101}, "'hidden' has 101 numbers, more than 100"),
        (RIGHT | {"negative_slope": []}, r"tracker.negative_slope must be a number in \[0, 1\), found \[\]"),
        (RIGHT | {"hidden": "ab"}, "tracker.hidden must be"),
        (RIGHT | {"lookahead": 10**40}, "tracker"),
        (RIGHT | {"state_dim": -4}, "tracker.state_dim must be"),
        ({"hidden": [4]}, "Tracker needs state_dim, control_dim, lookahead"),
        (RIGHT | {"size": 3}, "tracker.size: Tracker has no such option"),
        ([], "must be a mapping"),
        ("{" * 5000, "is not JSON|nested"),
    ],
)
def test_arguments_that_do_not_fit_are_one_line_with_the_file(arguments, message, example):
    record = dataclasses.replace(
        example(TrackerModel),
        weights=weights_of(Tracker(**RIGHT)),
        arguments=arguments if isinstance(arguments, str) else json.dumps(arguments),
    )
    artifact = Artifact(Path("tracker.h5"), "", Header("train-tracker", "x", {"tracker": {"name": "mlp"}}), record)
    with pytest.raises(ArtifactError, match=f"tracker.h5: .*({message})") as error:
        tracker_from(artifact)
    assert "\n" not in str(error.value)
