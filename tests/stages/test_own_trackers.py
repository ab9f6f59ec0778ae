"""Trackers that are not the paper's, through the whole pipeline: of an ONNX file, and of a plugin."""

from __future__ import annotations

import json

import h5py
import numpy as np
import pytest
import torch

from sagemp_cli.checker.check import check
from sagemp_cli.errors import ArtifactError
from sagemp_cli.loop.controller import lookahead_errors
from sagemp_cli.loop.onnx_format.tracker import OnnxTracker
from sagemp_cli.loop.onnx_format.writing import write_onnx
from sagemp_cli.loop.tracker import Tracker
from sagemp_cli.pipeline.freshness import Freshness, survey
from sagemp_cli.pipeline.models import tracker_from
from sagemp_cli.pipeline.stage import stage_named
from sagemp_cli.plugins import registry
from sagemp_cli.storage import TrackerModel, read_artifact
from sagemp_cli.storage.content import content_hash


@pytest.fixture
def network(toy_folder, tmp_path):
    """The toy's own tracker as an ONNX file."""
    pytest.importorskip("onnx", reason="the extra 'onnx' is not installed")
    path = tmp_path / "net.onnx"
    write_onnx(tracker_from(read_artifact(toy_folder / "tracker.h5", TrackerModel)), path)
    return path


def made(context, *stages):
    return [context.read(stage) for stage in stages if stage_named(stage).run(context)]


def test_a_network_of_a_file_goes_through_all_stages_and_proves_the_same(work, network, toy_folder):
    few = ("library.size=1", "execute.queries=1", "execute.rollouts=2", "safety.references=1", "safety.rollouts=2")
    context = work("gen-data", "train-planner", overrides=("tracker=onnx", f"tracker.path={network}", *few))
    stages = ("train-tracker", "verify", "build-library", "execute", "safety-rates")
    tracker, certificate, library, rollouts, _ = made(context, *stages)
    assert isinstance(tracker_from(tracker), OnnxTracker)
    assert [p.role for p in tracker.header.parents] == ["network"]
    ours = read_artifact(toy_folder / "certificate.h5", type(certificate.record)).record
    assert certificate.record.verdict == ours.verdict
    assert check(certificate.path).answer == ours.verdict
    np.testing.assert_allclose(certificate.record.tubes.tube_upper, ours.tubes.tube_upper, rtol=1e-9, atol=1e-9)
    assert bool(rollouts.record.in_tube.all()) and len(library.record.tubes.verdict) > 0
    states = survey(context, last="safety-rates")
    assert {state.freshness for state in states.values()} == {Freshness.FRESH}


def test_it_is_taken_without_a_planner_and_the_file_is_not_needed_again(work, network):
    context = work(overrides=("tracker=onnx", f"tracker.path={network}"))
    made(context, "train-tracker")
    network.unlink()
    assert isinstance(tracker_from(context.read("train-tracker")), OnnxTracker)


def test_a_changed_network_makes_what_was_taken_from_it_stale(work, network):
    context = work(overrides=("tracker=onnx", f"tracker.path={network}"))
    made(context, "train-tracker")
    with torch.no_grad():
        tracker = tracker_from(context.read("train-tracker"))
        tracker.control_offset[0] = 0.5
    write_onnx(tracker, network, overwrite=True)
    state = survey(context, last="train-tracker")["train-tracker"]
    assert state.freshness is Freshness.STALE and "net.onnx has changed" in state.why


def test_an_artifact_that_names_a_file_instead_of_holding_a_network_is_refused(work, network):
    context = work(overrides=("tracker=onnx", f"tracker.path={network}"))
    made(context, "train-tracker")
    path = context.output_path("train-tracker")
    with h5py.File(path, "r+") as file:
        arguments = json.loads(file["data"].attrs["arguments"])
        file["data"].attrs["arguments"] = json.dumps({k: v for k, v in arguments.items() if k != "network"})
        file.attrs["content_sha256"] = content_hash(file)
    artifact = read_artifact(path, TrackerModel)
    with pytest.raises(ArtifactError, match="made by train-tracker"):
        tracker_from(artifact)


class BodyFrame(Tracker):
    """Errors in the robot's own frame."""

    def features(self, window, x):
        e = lookahead_errors(window, x)
        cos, sin = torch.cos(x[..., 2:3]), torch.sin(x[..., 2:3])
        return torch.stack(
            [cos * e[..., 0] + sin * e[..., 1], cos * e[..., 1] - sin * e[..., 0], *e[..., 2:].unbind(-1)], -1
        )


@pytest.fixture
def body_frame(monkeypatch):
    monkeypatch.setattr(registry, "_registered", dict(registry._registered))
    registry.tracker("body_frame")(BodyFrame)


def test_a_tracker_on_features_of_ones_own_is_trained_and_proved(work, body_frame):
    options = ("tracker.name=body_frame", "tracker_training.tube=null", "tracker_training.steps=3")
    context = work("train-planner", overrides=(*options, "verify.falsifier=null"))
    tracker, certificate = made(context, "train-tracker", "verify")
    found = tracker_from(tracker)
    assert isinstance(found, BodyFrame) and len(tracker.record.curve.step) == 3
    assert np.isfinite(certificate.record.tubes.tube_upper[:, 0]).all()
