"""``sagemp export tracker``."""

from __future__ import annotations

import pytest
import torch
from typer.testing import CliRunner

from sagemp_cli.cli.main import app
from sagemp_cli.loop.onnx_format.tracker import OnnxTracker
from sagemp_cli.pipeline.models import tracker_from
from sagemp_cli.storage import TrackerModel, read_artifact

pytest.importorskip("onnx", reason="the extra 'onnx' is not installed")


def test_a_tracker_is_exported_exactly_and_never_over_another_file(toy_root, toy_folder, tmp_path):
    path = tmp_path / "net.onnx"
    call = ["export", "tracker", "effort=toy", f"artifacts={toy_root}", "--onnx", str(path)]
    said = CliRunner().invoke(app, call)
    assert said.exit_code == 0 and "exact numbers" in said.output
    ours = tracker_from(read_artifact(toy_folder / "tracker.h5", TrackerModel))
    again = OnnxTracker.taken(state_dim=4, control_dim=2, path=str(path))
    x, window = torch.randn(50, 4).double(), torch.randn(50, ours.lookahead, 4).double()
    with torch.no_grad():
        assert torch.equal(again.control(window, x), ours.control(window, x))
    refused = CliRunner().invoke(app, call)
    assert refused.exit_code == 2 and "exists already" in refused.output
    rounded = CliRunner().invoke(app, [*call, "--float32", "--overwrite"])
    assert rounded.exit_code == 0 and "measured, not proved" in " ".join(rounded.output.split())
