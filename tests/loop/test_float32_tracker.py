"""A tracker in float32 is the one that ``export --float32`` writes, and its controls stay within what it says."""

import numpy as np
import pytest
import torch

from sagemp_cli.errors import ConfigError
from sagemp_cli.loop.onnx_format.layers import Layer, Network
from sagemp_cli.loop.onnx_format.lowering import read_network
from sagemp_cli.loop.onnx_format.writing import write_onnx
from sagemp_cli.loop.tracker import Tracker


def tracker(**options):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return Tracker(
            state_dim=4, control_dim=2, lookahead=3, hidden=[6, 5], error_scale=[0.3, 1.0, 7.0, 1.0],
            control_scale=[0.7, 1.3], control_offset=[0.1, -9.81], precision="float32", **options,
        ).requires_grad_(False)  # fmt: skip


def test_it_is_what_a_float32_file_gives(tmp_path):
    reference = pytest.importorskip("onnx.reference")
    made = tracker(saturate=True)
    write_onnx(made, tmp_path / "net.onnx", float32=True)
    errors = torch.randn(200, 3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    run = reference.ReferenceEvaluator(str(tmp_path / "net.onnx"))
    name = run.input_names[0]
    (theirs,) = run.run(None, {name: errors.float().flatten(-2).numpy()})
    ours = made(errors)
    assert ours.dtype is torch.float64 and torch.equal(ours, ours.float().double())
    np.testing.assert_allclose(ours.numpy(), theirs, rtol=3e-6, atol=3e-6)
    real = tracker(saturate=True)
    real.precision = "real"
    assert 0 < float((real(errors) - ours).abs().max()) < 1e-5
    assert torch.equal(read_network(tmp_path / "net.onnx")(errors.flatten(-2).float()), ours.float())


def test_controls_stay_within_their_range():
    made = tracker(saturate=True)
    low, high = made.control_range()
    found = made(1e4 * torch.randn(5000, 3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1)))
    assert bool(((low <= found) & (found <= high)).all())
    real = [0.1 - 0.7, -9.81 - 1.3], [0.1 + 0.7, -9.81 + 1.3]
    for side, exact in zip((low, high), real, strict=True):
        assert 0 < float((side - torch.tensor(exact)).abs().max()) < 1e-5


def test_what_float32_does_not_hold_is_refused():
    network = Network(
        1, [Layer("linear", 1, (0,))], {"layer1_weight": torch.full((1, 1), 0.1).double() + 1e-12,
                                        "layer1_bias": torch.zeros(1).double()},
    )  # fmt: skip
    with pytest.raises(ConfigError, match="weight of layer 1 has numbers that are not of float32"):
        network(torch.ones(1))
    with pytest.raises(ConfigError, match="precision must be one of real, float32, found 'half'"):
        Tracker(state_dim=1, control_dim=1, lookahead=1, hidden=[1], precision="half")
